"""Ask/tell optimizers over a box: NumPy arrays in and out, seeded, independent of radio.

Every class is an `Optimizer` and states what it uses, how it keeps to a budget and whether it takes starting points.
`METHODS` lists them by the names of a study file, and `make` makes one. Optional libraries are imported only when their
class is constructed.
"""

from calibray.optimizers.cma_es import CMAES
from calibray.optimizers.dfo_ls import DFOLS
from calibray.optimizers.differential_evolution import DifferentialEvolution
from calibray.optimizers.evaluations import Best
from calibray.optimizers.gauss_newton import GaussNewton
from calibray.optimizers.gaussian_process import GaussianProcess
from calibray.optimizers.gwo import GWO
from calibray.optimizers.least_squares import LeastSquares
from calibray.optimizers.methods import METHODS, label, make, method
from calibray.optimizers.multifidelity.space_mapping import SpaceMapping
from calibray.optimizers.pounders import POUNDERS
from calibray.optimizers.protocol import Optimizer
from calibray.optimizers.sampling import LatinHypercube, RandomSearch, Sobol
from calibray.optimizers.sgwoim import SGWOIM
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
