"""Generate the demo district: `python -m calibray.scenarios FOLDER`."""

import sys
from pathlib import Path

from calibray.scenarios.campaign import generate

if len(sys.argv) != 2:
    sys.exit("usage: python -m calibray.scenarios FOLDER")
generate(Path(sys.argv[1]))
