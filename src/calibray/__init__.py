"""Calibrate the radio materials of a ray-traced scene from measurements.

Names are loaded when first used, so that importing the package costs nothing.
"""

from calibray.lazy import lazily

_HOMES = {
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
    "Setup": "calibray.study",
    "Result": "calibray.result",
    "calibrate": "calibray.calibration.calibrate",
    "engines": "calibray.engines",
    "optimizers": "calibray.optimizers",
    "report": "calibray.reporting.page",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = lazily(__name__, _HOMES)
