"""How a material's constants follow the frequency: eps_r = a f^b and sigma = c f^d [S/m], f in GHz (ITU-R P.2040).

A material that ITU-R gives by name has the coefficients of Table 3; any other one keeps its constants at every
frequency, which is the same law with the exponents 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import product
from math import inf, log
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import BOUNDS, FIELDS, Bound, ItuLaw, Material

LAWS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {"relative_permittivity": ("itu_a", "itu_b"), "conductivity": ("itu_c", "itu_d")}
)
"""The constants that follow the frequency, each with the coefficient and the exponent of its law, as parameters."""

CONSTANT: Final[Mapping[str, str]] = MappingProxyType(
    {
        **{field: field for field in FIELDS},
        **{coefficient: constant for constant, law in LAWS.items() for coefficient in law},
    }
)
"""What a parameter may be, each with the constant of the material that it acts on."""

PARAMETER_BOUNDS: Final[Mapping[str, Bound]] = MappingProxyType(
    {
        **BOUNDS,
        "itu_a": Bound(0.0, inf, "1", open_below=True),
        "itu_b": Bound(-10.0, 10.0, "1"),
        "itu_c": Bound(0.0, inf, "S/m"),
        "itu_d": Bound(-10.0, 10.0, "1"),
    }
)
"""The physical bounds of each parameter; those of a law's coefficients leave its value to `check_law`."""


class Power(NamedTuple):
    """A power law s f^e with its derivatives.

    Attributes:
        value: The value.
        by_scale: Its derivative by s.
        by_exponent: Its derivative by e.
    """

    value: NDArray[np.float64]
    by_scale: NDArray[np.float64]
    by_exponent: NDArray[np.float64]


def power(scale: NDArray[np.float64], exponent: NDArray[np.float64], frequency: float) -> Power:
    """The law s f^e at one frequency.

    Args:
        scale: s [...], in the constant's unit.
        exponent: e [...].
        frequency: Frequency [Hz].

    Returns:
        The law [...].
    """
    frequency_ghz = frequency / 1e9
    rise = frequency_ghz**exponent
    value = scale * rise
    return Power(value, rise, value * log(frequency_ghz))


def frequency_independent_law(material: Material) -> ItuLaw:
    """The law of a material whose constants are the same at every frequency."""
    return ItuLaw(0, inf, material.relative_permittivity, 0.0, material.conductivity, 0.0)


def check_law(
    material: str,
    constant: str,
    scales: Iterable[float],
    exponents: Iterable[float],
    frequencies: Iterable[float],
) -> None:
    """Refuse bounds of coefficients between which a constant leaves physics at some carrier.

    A power law is monotonous in both coefficients, so that the corners of their bounds tell.

    Args:
        material: The material's name.
        constant: "relative_permittivity" or "conductivity".
        scales: Bounds of the coefficient s, or its one value.
        exponents: Bounds of the exponent e, or its one value.
        frequencies: The carriers [Hz].

    Raises:
        InputError: s f^e lies outside the constant's bound.
    """
    names = LAWS[constant]
    for frequency, scale, exponent in product(frequencies, scales, exponents):
        value = float(power(np.array(scale), np.array(exponent), frequency).value)
        if value not in BOUNDS[constant]:
            raise InputError(
                f"{material}.{names[0]} = {scale:g} with {names[1]} = {exponent:g} gives {constant} = {value:.4g} at "
                f"{frequency / 1e9:g} GHz, must be {BOUNDS[constant]}; narrow the bounds"
            )
