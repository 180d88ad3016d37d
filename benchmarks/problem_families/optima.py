"""The lowest RMSE of planted problems, stored in Calibray's cache folder, because finding one takes many searches."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from calibray.support.cache_folder import cache_folder
from calibray.support.output_files import replacing


def find(fingerprint: str, starts: int) -> float | None:
    """The stored optimum [dB] of a problem from a number of local searches, or None."""
    path = _path(fingerprint, starts)
    with suppress(OSError, ValueError, KeyError, TypeError):
        if path is not None:
            return float(json.loads(path.read_text(encoding="utf-8"))["rmse_db"])
    return None


def keep(fingerprint: str, starts: int, rmse_db: float) -> None:
    """Store an optimum [dB]; nothing happens if the folder cannot be written."""
    path = _path(fingerprint, starts)
    if path is None:
        return
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            partial.write_text(json.dumps({"rmse_db": rmse_db}), encoding="utf-8")


def _path(fingerprint: str, starts: int) -> Path | None:
    folder = cache_folder()
    return None if folder is None else folder / f"optimum-{fingerprint[:40]}-{starts}.json"
