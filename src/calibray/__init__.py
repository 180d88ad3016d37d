"""Calibrate the radio materials of a ray-traced scene from measurements.

Names are loaded when first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "Material": "calibray.materials",
    "itu_material": "calibray.materials",
    "Measurements": "calibray.measurements",
    "read_measurements": "calibray.measurements",
    "Paths": "calibray.paths",
    "channel_statistics": "calibray.fields.channel",
    "power_delay_profile": "calibray.fields.channel",
    "trace": "calibray.study.tracing",
    "path_gains": "calibray.fields",
    "path_loss": "calibray.fields",
    "Study": "calibray.study",
    "Result": "calibray.result",
    "calibrate": "calibray.calibration",
    "engines": "calibray.engines",
    "optimizers": "calibray.optimizers",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'calibray' has no attribute {name!r}")
    module = import_module(_HOME[name])
    value = module if _HOME[name] == f"calibray.{name}" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
