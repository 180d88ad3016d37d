"""How a material's constants depend on frequency: eps_r = a f^b and sigma = c f^d [S/m], f in GHz (ITU-R P.2040).

A material that ITU-R lists has the coefficients of Table 3. Any other material has the same constants at all
frequencies: the same law with the exponents 0.
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
"""Constants that may depend on frequency, each with the parameters of its law: coefficient and exponent."""

CONSTANT_OF_FIELD: Final[Mapping[str, str]] = MappingProxyType(
    {
        **{field: field for field in FIELDS},
        **{coefficient: constant for constant, law in LAWS.items() for coefficient in law},
    }
)
"""Fields that a parameter may set, each with the constant of the material that it changes."""

EFFECTS: Final[Mapping[str, Mapping[str, Bound]]] = MappingProxyType(
    {
        "region": {"specific_attenuation": Bound(0.0, inf, "dB/m")},
        "tx": {
            "azimuth": Bound(-180.0, 180.0, "deg"),
            "downtilt": Bound(-90.0, 90.0, "deg"),
            "gain": Bound(-100.0, 100.0, "dB"),
            "height": Bound(-1000.0, 1000.0, "m"),
        },
        "rx": {"dx": Bound(-1000.0, 1000.0, "m"), "dy": Bound(-1000.0, 1000.0, "m")},
    }
)
"""Kinds of effects other than materials that have parameters, as in "region:trees.specific_attenuation", with the
physical bounds of each field."""

ROUGHNESS: Final = "roughness_mm"
"""Field of a material that acts as an effect on paths instead of as a constant: its roughness."""

PARAMETER_BOUNDS: Final[Mapping[str, Bound]] = MappingProxyType(
    {
        **BOUNDS,
        "itu_a": Bound(0.0, inf, "1", open_below=True),
        "itu_b": Bound(-10.0, 10.0, "1"),
        "itu_c": Bound(0.0, inf, "S/m"),
        "itu_d": Bound(-10.0, 10.0, "1"),
        ROUGHNESS: Bound(0.0, 1000.0, "mm"),
        **{field: bound for fields in EFFECTS.values() for field, bound in fields.items()},
    }
)
"""Physical bounds of each field; `check_law` checks the value of a law."""


class PowerLaw(NamedTuple):
    """Values of a power law s f^e and its derivatives [...].

    Attributes:
        value: The value.
        by_scale: Its derivative with respect to s.
        by_exponent: Its derivative with respect to e.
    """

    value: NDArray[np.float64]
    by_scale: NDArray[np.float64]
    by_exponent: NDArray[np.float64]


def power_law(scale: NDArray[np.float64], exponent: NDArray[np.float64], frequency: float) -> PowerLaw:
    """Evaluate s f^e at one frequency [Hz] for scales s [...], in the constant's unit, and exponents e [...]."""
    frequency_ghz = frequency / 1e9
    power = frequency_ghz**exponent
    value = scale * power  # ITU-R P.2040-1 eq. 58 and 59
    return PowerLaw(value, by_scale=power, by_exponent=value * log(frequency_ghz))


def frequency_independent_law(material: Material) -> ItuLaw:
    """The law of a material whose constants are the same at all frequencies."""
    return ItuLaw(0, inf, material.relative_permittivity, 0.0, material.conductivity, 0.0)


def check_law(
    material: str,
    constant: str,
    scales: Iterable[float],
    exponents: Iterable[float],
    frequencies: Iterable[float],
) -> None:
    """Refuse bounds of a law s f^e that allow an impossible value of a constant at some carrier [Hz].

    A power law is monotonic in both coefficients, so it is enough to check the corners of their bounds. A fixed
    coefficient has one value.

    Raises:
        InputError: s f^e lies outside the constant's bound.
    """
    scale_name, exponent_name = LAWS[constant]
    for frequency, scale, exponent in product(frequencies, scales, exponents):
        value = float(power_law(np.array(scale), np.array(exponent), frequency).value)
        if value not in BOUNDS[constant]:
            raise InputError(
                f"{material}.{scale_name} = {scale:g} with {exponent_name} = {exponent:g} gives "
                f"{constant} = {value:.4g} at {frequency / 1e9:g} GHz, must be {BOUNDS[constant]}; narrow the bounds"
            )
