"""Calibrate the radio materials of a ray-traced scene from measurements.

Most users need `Study`, `calibrate` and `Result`. Names are imported when first used, so that importing the package is
fast.

Example:
    >>> import calibray as cb
    >>> from calibray.scenarios import demo_study_path
    >>> study = cb.Study.load(demo_study_path())
    >>> len(study.parameters)
    3
"""

from typing import TYPE_CHECKING

from calibray.support.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from calibray import engines as engines
    from calibray import optimizers as optimizers
    from calibray.calibration.calibrate import calibrate as calibrate
    from calibray.calibration.result import Result as Result
    from calibray.fields import path_gains as path_gains
    from calibray.fields import path_loss as path_loss
    from calibray.fields.channel import channel_statistics as channel_statistics
    from calibray.fields.channel import power_delay_profile as power_delay_profile
    from calibray.materials import Material as Material
    from calibray.materials import itu_material as itu_material
    from calibray.measurements import Measurements as Measurements
    from calibray.measurements import read_measurements as read_measurements
    from calibray.paths import Paths as Paths
    from calibray.prediction.coverage_map import coverage_map as coverage_map
    from calibray.prediction.suggestion import suggest as suggest
    from calibray.reporting.page import report as report
    from calibray.study import Setup as Setup
    from calibray.study import Study as Study
    from calibray.study.trace import read_rays as read_rays
    from calibray.study.trace import trace as trace
    from calibray.study.trace import write_rays as write_rays
    from calibray.validation.validate import validate as validate
    from calibray.version import __version__ as __version__

# The module that defines each name.
_HOMES = {
    "Material": "calibray.materials",
    "itu_material": "calibray.materials",
    "Measurements": "calibray.measurements",
    "read_measurements": "calibray.measurements",
    "Paths": "calibray.paths",
    "channel_statistics": "calibray.fields.channel",
    "power_delay_profile": "calibray.fields.channel",
    "trace": "calibray.study.trace",
    "read_rays": "calibray.study.trace",
    "write_rays": "calibray.study.trace",
    "path_gains": "calibray.fields",
    "path_loss": "calibray.fields",
    "Study": "calibray.study",
    "Setup": "calibray.study",
    "Result": "calibray.calibration.result",
    "calibrate": "calibray.calibration.calibrate",
    "validate": "calibray.validation.validate",
    "suggest": "calibray.prediction.suggestion",
    "engines": "calibray.engines",
    "optimizers": "calibray.optimizers",
    "coverage_map": "calibray.prediction.coverage_map",
    "report": "calibray.reporting.page",
    "__version__": "calibray.version",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = lazy_attributes(__name__, _HOMES)
