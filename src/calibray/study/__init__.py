"""The study file: one calibration problem in TOML, read into a closed, validated model, and opened once."""

from typing import TYPE_CHECKING

from calibray.lazy import lazily

if TYPE_CHECKING:
    from calibray.study.model import VERSION as VERSION
    from calibray.study.model import Study as Study
    from calibray.study.reading import expand as expand
    from calibray.study.setup import Setup as Setup

_HOMES = {
    "VERSION": "calibray.study.model",
    "Setup": "calibray.study.setup",
    "Study": "calibray.study.model",
    "expand": "calibray.study.reading",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = lazily(__name__, _HOMES)
