"""Ask/tell optimizers over a box: NumPy arrays in and out, seeded, independent of radio.

Every class is an `Optimizer` and states what it uses, how it keeps to a budget and whether it takes starting points.
`METHODS` lists them by the names of a study file, and `make` makes one. Optional libraries are imported only when their
class is constructed.
"""

from calibray.optimizers.derivative_free import POUNDERS, GaussNewton
from calibray.optimizers.evaluations import Best
from calibray.optimizers.gaussian_process import GaussianProcess
from calibray.optimizers.grey_wolf import GWO, SGWOIM
from calibray.optimizers.least_squares import LeastSquares
from calibray.optimizers.libraries import CMAES, DFOLS, DifferentialEvolution
from calibray.optimizers.methods import METHODS, label, make, method
from calibray.optimizers.multifidelity.space_mapping import SpaceMapping
from calibray.optimizers.protocol import Optimizer
from calibray.optimizers.sampling import LatinHypercube, RandomSearch, Sobol
from calibray.optimizers.vector_surrogate import VectorSurrogate

__all__ = [
    "CMAES",
    "DFOLS",
    "GWO",
    "METHODS",
    "POUNDERS",
    "SGWOIM",
    "Best",
    "DifferentialEvolution",
    "GaussNewton",
    "GaussianProcess",
    "LatinHypercube",
    "LeastSquares",
    "Optimizer",
    "RandomSearch",
    "Sobol",
    "SpaceMapping",
    "VectorSurrogate",
    "label",
    "make",
    "method",
]
