"""Calibrate the radio materials of a ray-traced scene from measurements.

Most users need `Study`, `calibrate` and `Result`. Names are imported on first use, so that importing the package is
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
    from calibray.errors import EngineError as EngineError
    from calibray.errors import InputError as InputError
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

__version__ = "0.1.0"

_lazy, __getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "engines": "",
        "optimizers": "",
        "calibration.calibrate": "calibrate",
        "calibration.result": "Result",
        "errors": "EngineError InputError",
        "fields": "path_gains path_loss",
        "fields.channel": "channel_statistics power_delay_profile",
        "materials": "Material itu_material",
        "measurements": "Measurements read_measurements",
        "paths": "Paths",
        "prediction.coverage_map": "coverage_map",
        "prediction.suggestion": "suggest",
        "reporting.page": "report",
        "study": "Setup Study",
        "study.trace": "read_rays trace write_rays",
        "validation.validate": "validate",
    },
)
__all__ = [*_lazy, "__version__"]
