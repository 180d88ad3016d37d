#!/bin/sh
# Builds the sdist, and the wheel from the sdist; installs the wheel into a fresh environment and runs the demo there.
# usage: check_package.sh PYTHON
set -eu
python=$1
root=$(cd "$(dirname "$0")/.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

"$python" -m pip install --quiet --disable-pip-version-check --target "$folder/build" build
PYTHONPATH="$folder/build" "$python" -m build --outdir "$folder/dist" "$root"
"$python" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check \
    --constraint "$root/requirements.lock" "$folder"/dist/calibray-*.whl
cd "$folder"
env -u PYTHONPATH "$folder/env/bin/calibray" --version
env -u PYTHONPATH "$folder/env/bin/calibray" demo --out "$folder/demo"
test -s "$folder/demo/report.html"
