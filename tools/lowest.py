"""Print the lowest versions of Calibray's direct dependencies that pyproject.toml allows, as constraints for pip.

Usage: `python tools/lowest.py EXTRA ...`
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def lowest(requirements: list[str]) -> dict[str, str]:
    """The lowest version of each requirement that states one."""
    pattern = re.compile(r"^([\w.-]+)(?:\[[\w,]+\])?>=([\w.]+)")
    matches = (pattern.match(requirement) for requirement in requirements)
    return {match[1]: match[2] for match in matches if match}


if __name__ == "__main__":
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    requirements = [*project["dependencies"]]
    for extra in sys.argv[1:]:
        requirements += project["optional-dependencies"][extra]
    for name, version in sorted(lowest(requirements).items()):
        sys.stdout.write(f"{name}=={version}\n")
