"""The lowest RMSE of planted problems, kept in Calibray's cache folder: finding one takes many local searches."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from pathlib import Path
from typing import Final

from calibray.support.cache_folder import cache_folder
from calibray.support.output_files import replacing

_ENTRY: Final = re.compile(r"optimum-[0-9a-f]{40}-[0-9]+\.json")


def find(fingerprint: str, starts: int) -> float | None:
    """The optimum of a problem, if it is kept.

    Args:
        fingerprint: Of the problem, hexadecimal.
        starts: Local searches that it was found by.

    Returns:
        The lowest RMSE [dB], or None.
    """
    path = _path(fingerprint, starts)
    if path is None or not path.is_file():
        return None
    with suppress(OSError, ValueError, KeyError, TypeError):
        return float(json.loads(path.read_text(encoding="utf-8"))["rmse_db"])
    return None


def keep(fingerprint: str, starts: int, rmse_db: float) -> None:
    """Keep an optimum; where the folder cannot be written, it is simply not kept.

    Args:
        fingerprint: Of the problem, hexadecimal.
        starts: Local searches that it was found by.
        rmse_db: The lowest RMSE [dB].
    """
    path = _path(fingerprint, starts)
    if path is None:
        return
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            partial.write_text(json.dumps({"rmse_db": rmse_db}), encoding="utf-8")


def kept() -> list[Path]:
    """The files of the optima that are kept."""
    here = cache_folder()
    if here is None or not here.is_dir():
        return []
    return sorted(path for path in here.iterdir() if _ENTRY.fullmatch(path.name) and path.is_file())


def _path(fingerprint: str, starts: int) -> Path | None:
    here = cache_folder()
    return None if here is None else here / f"optimum-{fingerprint[:40]}-{starts}.json"
