"""The least squares problems of Moré and Wild: 22 functions in 53 combinations of dimension and starting point.

J. J. Moré, S. M. Wild, "Benchmarking Derivative-Free Optimization Algorithms", SIAM J. Optim. 20 (2009) 172; most
functions are from J. J. Moré, B. S. Garbow, K. E. Hillstrom, ACM Trans. Math. Softw. 7 (1981) 17, others from CUTEst.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

BARD: Final = np.array([14, 18, 22, 25, 29, 32, 35, 39, 37, 58, 73, 96, 134, 210, 439]) / 100
KOWALIK: Final = np.array([1957, 1947, 1735, 1600, 844, 627, 456, 342, 323, 235, 246]) / 1e4
KOWALIK_V: Final = np.array([4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])
MEYER: Final = np.array(
    [34780, 28610, 23650, 19630, 16370, 13720, 11540, 9744, 8261, 7030, 6005, 5147, 4427, 3820, 3307, 2872]
)
OSBORNE_1: Final = np.array(
    [844, 908, 932, 936, 925, 908, 881, 850, 818, 784, 751, 718, 685, 658, 628, 603, 580, 558, 538, 522, 506, 490,
     478, 467, 457, 448, 438, 431, 424, 420, 414, 411, 406]
) / 1e3  # fmt: skip
OSBORNE_2: Final = np.array(
    [1366, 1191, 1112, 1013, 991, 885, 831, 847, 786, 725, 746, 679, 608, 655, 616, 606, 602, 626, 651, 724, 649, 649,
     694, 644, 624, 661, 612, 558, 533, 495, 500, 423, 395, 375, 372, 391, 396, 405, 428, 429, 523, 562, 607, 653, 672,
     708, 633, 668, 645, 632, 591, 559, 597, 625, 739, 710, 729, 720, 636, 581, 428, 292, 162, 98, 54]
) / 1e3  # fmt: skip


def linear_full_rank(x: Vector, m: int) -> Vector:
    """Problem 1."""
    return np.append(x, np.zeros(m - len(x))) - 2 * x.sum() / m - 1


def linear_rank_one(x: Vector, m: int) -> Vector:
    """Problem 2."""
    return np.arange(1, m + 1) * (np.arange(1, len(x) + 1) @ x) - 1


def linear_rank_one_with_zeros(x: Vector, m: int) -> Vector:
    """Problem 3: the first and last parameter and residual have no effect."""
    return np.append(np.arange(m - 1) * (np.arange(2, len(x)) @ x[1:-1]), 0) - 1


def rosenbrock(x: Vector, m: int) -> Vector:
    """Problem 4."""
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def helical_valley(x: Vector, m: int) -> Vector:
    """Problem 5."""
    turn = 0.25 if x[0] == 0 else np.arctan(x[1] / x[0]) / (2 * np.pi) + 0.5 * (x[0] < 0)
    return np.array([10 * (x[2] - 10 * turn), 10 * (np.hypot(x[0], x[1]) - 1), x[2]])


def powell_singular(x: Vector, m: int) -> Vector:
    """Problem 6."""
    a, b, c, d = x
    return np.array([a + 10 * b, np.sqrt(5) * (c - d), (b - 2 * c) ** 2, np.sqrt(10) * (a - d) ** 2])


def freudenstein_roth(x: Vector, m: int) -> Vector:
    """Problem 7."""
    a, b = x
    return np.array([-13 + a + ((5 - b) * b - 2) * b, -29 + a + ((1 + b) * b - 14) * b])


def bard(x: Vector, m: int) -> Vector:
    """Problem 8."""
    u = np.arange(1, 16)
    return BARD - (x[0] + u / (x[1] * (16 - u) + x[2] * np.minimum(u, 16 - u)))


def kowalik_osborne(x: Vector, m: int) -> Vector:
    """Problem 9."""
    v = KOWALIK_V
    return KOWALIK - x[0] * v * (v + x[1]) / (v * (v + x[2]) + x[3])


def meyer(x: Vector, m: int) -> Vector:
    """Problem 10."""
    return x[0] * np.exp(x[1] / (45 + 5 * np.arange(1, 17) + x[2])) - MEYER


def watson(x: Vector, m: int) -> Vector:
    """Problem 11."""
    power = (np.arange(1, 30)[:, None] / 29) ** np.arange(len(x))
    slope = power[:, :-1] @ (np.arange(1, len(x)) * x[1:])
    return np.concatenate([slope - (power @ x) ** 2 - 1, [x[0], x[1] - x[0] ** 2 - 1]])


def box(x: Vector, m: int) -> Vector:
    """Problem 12."""
    t = np.arange(1, m + 1) / 10
    return np.exp(-t * x[0]) - np.exp(-t * x[1]) + (np.exp(-10 * t) - np.exp(-t)) * x[2]


def jennrich_sampson(x: Vector, m: int) -> Vector:
    """Problem 13."""
    i = np.arange(1, m + 1)
    return 2 + 2 * i - np.exp(i * x[0]) - np.exp(i * x[1])


def brown_dennis(x: Vector, m: int) -> Vector:
    """Problem 14."""
    t = np.arange(1, m + 1) / 5
    return (x[0] + t * x[1] - np.exp(t)) ** 2 + (x[2] + np.sin(t) * x[3] - np.cos(t)) ** 2


def chebyquad(x: Vector, m: int) -> Vector:
    """Problem 15: means of shifted Chebyshev polynomials minus their integrals over [0, 1]."""
    i = np.arange(1, m + 1)
    means = np.polynomial.chebyshev.chebvander(2 * x - 1, m)[:, 1:].mean(axis=0)
    return means + np.where(i % 2 == 0, 1 / np.maximum(i.astype(float) ** 2 - 1, 1), 0)


def brown_almost_linear(x: Vector, m: int) -> Vector:
    """Problem 16."""
    return np.append(x[:-1] + x.sum() - len(x) - 1, np.prod(x) - 1)


def osborne_1(x: Vector, m: int) -> Vector:
    """Problem 17."""
    t = 10.0 * np.arange(33)
    return OSBORNE_1 - (x[0] + x[1] * np.exp(-t * x[3]) + x[2] * np.exp(-t * x[4]))


def osborne_2(x: Vector, m: int) -> Vector:
    """Problem 18."""
    t = np.arange(65) / 10
    peaks = sum(x[k] * np.exp(-x[k + 4] * (t - x[k + 7]) ** 2) for k in (1, 2, 3))
    return OSBORNE_2 - (x[0] * np.exp(-t * x[4]) + peaks)


def bdqrtic(x: Vector, m: int) -> Vector:
    """Problem 19."""
    n = len(x) - 4
    squares = sum((k + 1) * x[k : k + n] ** 2 for k in range(4)) + 5 * x[-1] ** 2
    return np.concatenate([3 - 4 * x[:n], squares])


def cube(x: Vector, m: int) -> Vector:
    """Problem 20."""
    return np.append(x[0] - 1, 10 * (x[1:] - x[:-1] ** 3))


def mancino(x: Vector, m: int) -> Vector:
    """Problem 21."""
    return 1400 * x + _mancino_rest(x)


def _mancino_rest(x: Vector) -> Vector:
    i = np.arange(1, len(x) + 1)
    v = np.sqrt(x[:, None] ** 2 + i[:, None] / i)
    angle = np.log(v)
    return (i - 50.0) ** 3 + (v * (np.sin(angle) ** 5 + np.cos(angle) ** 5)).sum(axis=1)


def heart(x: Vector, m: int) -> Vector:
    """Problem 22: HEART8LS of CUTEst; moments of two dipoles, expressed as powers of complex numbers."""
    first, second = x[0] + 1j * x[2], x[1] + 1j * x[3]
    p, q = x[4] + 1j * x[6], x[5] + 1j * x[7]
    measured = (-0.69 - 0.044j, -1.57 - 1.31j, -2.65 + 2j, -12.6 + 9.48j)
    moments = [first * p**k + second * q**k - value for k, value in enumerate(measured)]
    return np.array([part for moment in moments for part in (moment.real, moment.imag)])


def _started(*values: float) -> Callable[[int], Vector]:
    """A starting point, or one starting value for all parameters."""
    return lambda n: np.full(n, values[0]) if len(values) == 1 else np.array(values)


FUNCTIONS: Final[tuple[tuple[Callable[[Vector, int], Vector], Callable[[int], Vector]], ...]] = (
    (linear_full_rank, _started(1.0)),
    (linear_rank_one, _started(1.0)),
    (linear_rank_one_with_zeros, _started(1.0)),
    (rosenbrock, _started(-1.2, 1)),
    (helical_valley, _started(-1, 0, 0)),
    (powell_singular, _started(3, -1, 0, 1)),
    (freudenstein_roth, _started(0.5, -2)),
    (bard, _started(1.0)),
    (kowalik_osborne, _started(0.25, 0.39, 0.415, 0.39)),
    (meyer, _started(0.02, 4000, 250)),
    (watson, _started(0.5)),
    (box, _started(0, 10, 20)),
    (jennrich_sampson, _started(0.3, 0.4)),
    (brown_dennis, _started(25, 5, -5, -1)),
    (chebyquad, lambda n: np.arange(1, n + 1) / (n + 1)),
    (brown_almost_linear, _started(0.5)),
    (osborne_1, _started(0.5, 1.5, 1, 0.01, 0.02)),
    (osborne_2, _started(1.3, 0.65, 0.65, 0.7, 0.6, 3, 5, 7, 2, 4.5, 5.5)),
    (bdqrtic, _started(1.0)),
    (cube, _started(0.5)),
    (mancino, lambda n: -8.710996e-4 * _mancino_rest(np.zeros(n))),
    (heart, _started(-0.3, -0.39, 0.3, -0.344, -1.2, 2.69, 1.59, -1.5)),
)
"""The functions in the order of their numbers, with their standard starting points."""

COMBINATIONS: Final = (
    (1, 9, 45, 2), (2, 7, 35, 2), (3, 7, 35, 2), (4, 2, 2, 2), (5, 3, 3, 2), (6, 4, 4, 2), (7, 2, 2, 2), (8, 3, 15, 2),
    (9, 4, 11, 1), (10, 3, 16, 1), (11, 6, 31, 2), (11, 9, 31, 2), (11, 12, 31, 2), (12, 3, 10, 1), (13, 2, 10, 1),
    (14, 4, 20, 2), (15, 6, 6, 1), (15, 7, 7, 1), (15, 8, 8, 1), (15, 9, 9, 1), (15, 10, 10, 1), (15, 11, 11, 1),
    (16, 10, 10, 1), (17, 5, 33, 1), (18, 11, 65, 2), (19, 8, 8, 1), (19, 10, 12, 1), (19, 11, 14, 1), (19, 12, 16, 1),
    (20, 5, 5, 1), (20, 6, 6, 1), (20, 8, 8, 1), (21, 5, 5, 2), (21, 8, 8, 1), (21, 10, 10, 1), (21, 12, 12, 2),
    (22, 8, 8, 2),
)  # fmt: skip
"""Number of the function, and numbers of parameters, residuals and starting points (the standard one, ten times it)."""


@dataclass(frozen=True, eq=False)
class MoreWild:
    """One problem.

    Attributes:
        name: Function, dimension and factor of the starting point.
        start: The starting point [n].
        residuals: Residuals [m] at a point [n].
    """

    name: str
    start: Vector
    residuals: Callable[[Vector], Vector]


def problems() -> list[MoreWild]:
    """The 53 problems."""
    return [
        MoreWild(
            f"{function.__name__}-{n}x{10**power}",
            10.0**power * start(n),
            lambda x, function=function, m=m: function(x, m),
        )
        for number, n, m, count in COMBINATIONS
        for function, start in (FUNCTIONS[number - 1],)
        for power in range(count)
    ]
