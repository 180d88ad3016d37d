#!/bin/sh
# Makes a virtual environment, if it is not there yet, with a Python that is new enough.
# usage: make_venv.sh PYTHON FOLDER
set -eu
python=$1
venv=$2

if ! version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])'); then
    echo "Calibray needs Python 3.11 or newer, and '$python' does not run. Name another: make PYTHON=python3.12" >&2
    exit 1
fi
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    echo "Calibray needs Python 3.11 or newer, and '$python' is $version. Name another: make PYTHON=python3.12" >&2
    exit 1
fi

# Debian and Ubuntu split the venv module's pip into a package of its own.
if ! "$python" -c 'import ensurepip' 2>/dev/null; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        apt-get update
        apt-get install --yes "python$version-venv"
    else
        echo "'$python' cannot make virtual environments. To change that: sudo apt-get install python$version-venv" >&2
        exit 1
    fi
fi

[ -x "$venv/bin/pip" ] || "$python" -m venv "$venv"
