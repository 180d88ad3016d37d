#!/bin/sh
# Sees to the libraries that the ray tracer needs beside its Python packages, a libLLVM above all: installs them
# where that is allowed, else says how and fails.
# usage: ensure_runtime.sh PYTHON
set -eu
python=$1

# Prints the choice, or what is wrong and the command that puts it right.
"$python" -m calibray.tracing.llvm && exit 0

# A library that the user asked for is the user's to correct.
if [ -z "${DRJIT_LIBLLVM_PATH:-}" ] && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    apt-get update
    apt-get install --yes libllvm19 libatomic1
    exec "$python" -m calibray.tracing.llvm
fi
exit 1
