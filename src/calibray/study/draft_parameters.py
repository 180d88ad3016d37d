"""Which parameters a drafted study calibrates."""

from __future__ import annotations

from typing import Any, Final

from calibray.errors import InputError
from calibray.scenes import read_scene

METAL: Final = 1e6  # [S/m], a conductivity beyond which a path loss tells nothing of it
MOST_MATERIALS: Final = 6


def calibratable(
    scene: str, frequency: float, indoors: bool
) -> tuple[tuple[str, ...], dict[str, dict[str, Any]]]:
    """The materials of a scene that links may tell something of, and their parameters.

    Args:
        scene: Mitsuba XML file, or `sionna:NAME`.
        frequency: Carrier frequency [Hz].
        indoors: Whether links lead through walls, so that conductivities matter.

    Returns:
        The materials' names, and the entries of ``[parameters]``.

    Raises:
        InputError: The scene cannot be read, or all its materials are metal or air.
    """
    chosen = {
        name: constants
        for name, constants in read_scene(scene, frequency).materials.items()
        if constants.conductivity < METAL and constants.relative_permittivity > 1.5
    }
    names = tuple(chosen)[:MOST_MATERIALS]
    if not names:
        raise InputError(f"{scene}: has no material to calibrate; all are metal or air")
    entries: dict[str, dict[str, Any]] = {}
    for name in names:
        constants = chosen[name]
        upper = max(15.0, round(2 * constants.relative_permittivity))
        entries[f"{name}.relative_permittivity"] = {"bounds": [1.5, upper]}
        if indoors and constants.conductivity > 0:
            entries[f"{name}.conductivity"] = {
                "bounds": [min(1e-3, float(f"{constants.conductivity / 10:.0e}")), 3.0],
                "scale": "log",
            }
    return names, entries
