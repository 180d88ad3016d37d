"""Write requirements.lock: the installed versions of all packages that Calibray needs.

Usage, in an environment where Calibray and its extras are installed and tested: `python tools/lock.py`
"""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

LOCK = Path(__file__).resolve().parents[1] / "requirements.lock"


def needed(
    package: str, extras: frozenset[str], found: dict[tuple[str, frozenset[str]], str]
) -> set[tuple[str, str]]:
    """Follow the requirements of a package.

    Args:
        package: Name of an installed package.
        extras: Extras of the package to include.
        found: Versions of the packages found so far, each with its extras; the dependencies of `package` are added.

    Returns:
        Name and installed version of each package in `found`.
    """
    for line in metadata.requires(package) or []:
        requirement = Requirement(line)
        name = canonicalize_name(requirement.name)
        marker = requirement.marker
        wanted = marker is None or any(marker.evaluate({"extra": extra}) for extra in extras | {""})
        if wanted and (name, more := frozenset(requirement.extras)) not in found:
            found[name, more] = metadata.version(name)
            needed(name, more, found)
    return {(name, version) for (name, _), version in found.items()}


if __name__ == "__main__":
    every_extra = frozenset(metadata.metadata("calibray").get_all("Provides-Extra") or [])
    packages = needed("calibray", every_extra, {})
    LOCK.write_text("".join(f"{name}=={version}\n" for name, version in sorted(packages)))
