"""A validation beside a result: held-out errors of every model, written and read back whole."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.support.output_files import write_text

if TYPE_CHECKING:
    from calibray.validation.validation import Validation

FILE: Final = "result-validation.json"
VERSION: Final = 1


def write_validation(found: Validation, folder: Path) -> None:
    """Write a validation into a result's folder.

    Args:
        found: The validation.
        folder: The folder.
    """
    content = {
        "version": VERSION,
        **found.content(),
        "level": found.level,
        "links": {
            "block": found.block.tolist(),
            "position": np.round(found.position, 4).tolist(),
            "errors_db": {name: _open(errors) for name, errors in found.errors.items()},
        },
    }
    write_text(folder / FILE, json.dumps(content, indent=2) + "\n")


def read_validation(folder: Path, links: int) -> Validation | None:
    """Read a validation from a result's folder.

    Args:
        folder: The folder.
        links: Number of links of the result.

    Returns:
        The validation; None where none was made.

    Raises:
        InputError: The file was damaged, edited, or is of other links.
    """
    file = folder / FILE
    if not file.is_file():
        return None
    try:
        return _read(file, links)
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{file}: is no validation of `calibray validate` ({error}); validate again"
        ) from None


def _read(file: Path, links: int) -> Validation:
    from calibray.validation.validation import Validation

    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    if content["version"] != VERSION:
        raise InputError(f"{file}: has version {content['version']!r}, need {VERSION}; validate again")
    told = content["links"]
    block = np.array(told["block"], dtype=np.int64)
    position = np.array(told["position"], dtype=np.float64)
    errors = {str(name): np.array(values, dtype=np.float64) for name, values in told["errors_db"].items()}
    found = Validation(tuple(map(str, content["blocks"])), block, errors, position, float(content["level"]))
    lengths = {"block": len(block), "position": len(position), **{n: len(e) for n, e in errors.items()}}
    if wrong := [name for name, length in lengths.items() if length != links]:
        raise InputError(f"{file}: {wrong[0]} is not of the result's {links} links; validate again")
    judged = block >= 0
    if position.shape != (links, 3) or not judged.any() or block.max() >= len(found.labels):
        raise InputError(f"{file}: blocks or positions are not those of a validation; validate again")
    if not all(np.isfinite(values[judged]).all() for values in errors.values()):
        raise InputError(f"{file}: an error of a link that was judged is missing; validate again")
    found.summary()
    return found


def _open(values: NDArray[np.float64]) -> list[float | None]:
    """Values to 0.0001 dB; None for what is no number, which JSON does not know."""
    return [round(value, 4) if np.isfinite(value) else None for value in values.tolist()]
