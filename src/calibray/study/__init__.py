"""The study file: one calibration problem in TOML, read into a closed, validated model."""

from calibray.study.model import VERSION, Study, expand

__all__ = ["VERSION", "Study", "expand"]
