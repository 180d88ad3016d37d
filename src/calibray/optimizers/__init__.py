"""Ask/tell optimizers over a box: NumPy arrays in and out, seeded, and ignorant of radio.

Every class is an `Optimizer`; `METHODS` lists them by the names that a study file uses. A library that is not
installed is only missed when its class is constructed.
"""

from calibray.optimizers.archive import Best
from calibray.optimizers.gwo import GWO
from calibray.optimizers.least_squares import LeastSquares
from calibray.optimizers.protocol import Optimizer
from calibray.optimizers.sampling import LatinHypercube, RandomSearch, Sobol
from calibray.optimizers.sgwoim import SGWOIM
from calibray.optimizers.vector_surrogate import VectorSurrogate

METHODS: dict[str, type[Optimizer]] = {
    "gwo": GWO,
    "sgwo-im": SGWOIM,
    "vector-surrogate": VectorSurrogate,
    "least-squares": LeastSquares,
    "random": RandomSearch,
    "latin-hypercube": LatinHypercube,
    "sobol": Sobol,
}

__all__ = [
    "GWO",
    "METHODS",
    "SGWOIM",
    "Best",
    "LatinHypercube",
    "LeastSquares",
    "Optimizer",
    "RandomSearch",
    "Sobol",
    "VectorSurrogate",
]
