"""The study file: one calibration problem in TOML, read into a closed, validated model, and opened once."""

from calibray.study.model import VERSION, Study, expand
from calibray.study.setup import Setup

__all__ = ["VERSION", "Setup", "Study", "expand"]
