"""Parameters: the quantities that a calibration may change, their search space, and the laws to which some belong."""

from calibray.parameters.parameter import (
    Parameter,
    Scale,
    fixed_constant,
    is_effect,
    itu_start,
    split_name,
    start_value,
)
from calibray.parameters.priors import NO_PRIOR, LogNormal
from calibray.parameters.space import Parameters

__all__ = [
    "NO_PRIOR",
    "LogNormal",
    "Parameter",
    "Parameters",
    "Scale",
    "fixed_constant",
    "is_effect",
    "itu_start",
    "split_name",
    "start_value",
]
