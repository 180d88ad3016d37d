"""Write requirements.lock: the installed versions of all packages that Calibray needs.

Usage, in an environment where Calibray and its extras are installed and tested: `python tools/lock.py`
"""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

LOCK = Path(__file__).resolve().parents[1] / "requirements.lock"


def needed(package: str, extras: frozenset[str], found: dict[str, str]) -> dict[str, str]:
    """Follow the requirements of a package.

    Args:
        package: Name of an installed package.
        extras: Which of its extras are wanted.
        found: The packages met so far; those below this one are added.

    Returns:
        `found`: names with their installed versions.
    """
    for line in metadata.requires(package) or []:
        requirement = Requirement(line)
        name = canonicalize_name(requirement.name)
        marker = requirement.marker
        wanted = marker is None or any(marker.evaluate({"extra": extra}) for extra in extras | {""})
        if wanted and name not in found:
            found[name] = metadata.version(name)
            needed(name, frozenset(requirement.extras), found)
    return found


if __name__ == "__main__":
    every_extra = frozenset(metadata.metadata("calibray").get_all("Provides-Extra") or [])
    packages = needed("calibray", every_extra, {})
    LOCK.write_text("".join(f"{name}=={version}\n" for name, version in sorted(packages.items())))
