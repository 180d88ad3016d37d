"""Studies: the study file, which defines one calibration problem in TOML, and the opened study."""

from typing import TYPE_CHECKING

from calibray.support.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from calibray.study.setup import Setup as Setup
    from calibray.study.study import Study as Study
    from calibray.study.toml_file import expand as expand

__all__, __getattr__, __dir__ = lazy_attributes(
    __name__, {"setup": "Setup", "study": "Study", "toml_file": "expand"}
)
