"""Parameters: the quantities that a calibration changes, their search space and their frequency laws."""

from calibray.parameters.parameter import SCATTERING_SPREAD as SCATTERING_SPREAD
from calibray.parameters.parameter import Parameter as Parameter
from calibray.parameters.parameter import Scale as Scale
from calibray.parameters.parameter import fixed_constant as fixed_constant
from calibray.parameters.parameter import is_effect as is_effect
from calibray.parameters.parameter import itu_start as itu_start
from calibray.parameters.parameter import split_name as split_name
from calibray.parameters.parameter import start_value as start_value
from calibray.parameters.priors import NO_PRIOR as NO_PRIOR
from calibray.parameters.priors import LogNormal as LogNormal
from calibray.parameters.space import Parameters as Parameters
