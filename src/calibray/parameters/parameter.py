"""A single parameter: name, bounds, start value in a scene, and frequency law.

The constants of a material follow eps_r = a f^b and sigma = c f^d [S/m], with f in GHz (ITU-R P.2040). ITU-R materials
have the coefficients in Table 3 of P.2040. The constants of any other material do not depend on frequency, so their
exponents are 0.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from math import exp, inf, isfinite, log, pi, sqrt
from types import MappingProxyType
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import (
    BOUNDS,
    DEFAULT_REVISION,
    FIELDS,
    SCATTERING_PATTERNS,
    Bound,
    ItuLaw,
    Material,
    frequency_independent_law,
    itu_law,
    itu_material,
)
from calibray.support.messages import did_you_mean

Scale = Literal["linear", "log"]

_ITU_PREFIX: Final = "itu:"
_PATTERN_FIELDS: Final = ("alpha_r", "alpha_i", "lambda_")

LAWS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {"relative_permittivity": ("itu_a", "itu_b"), "conductivity": ("itu_c", "itu_d")}
)
"""Constants that can depend on frequency, each with the coefficient and exponent of its law."""

CONSTANT_OF_FIELD: Final[Mapping[str, str]] = MappingProxyType(
    {
        **{field: field for field in FIELDS},
        **{coefficient: constant for constant, law in LAWS.items() for coefficient in law},
    }
)
"""Fields that a parameter can set, each with the material constant that the field changes."""

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
"""Kinds of effects that have parameters but are not materials, with the physical bounds of each field. An example of a
parameter is "region:trees.specific_attenuation"."""

ROUGHNESS: Final = "roughness_mm"
"""Field of a material that describes an effect on paths instead of a constant."""

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
"""Physical bounds of each field. `check_law` checks the values of laws."""


@dataclass(frozen=True)
class Parameter:
    """One calibrated number: a field of a material or effect, with bounds and start value.

    Attributes:
        name: Material and field, separated by the last dot: "walls.relative_permittivity". Fields are the constants of
            a material, `roughness_mm`, and the coefficients `itu_a` to `itu_d` of the law of ITU-R P.2040: eps_r = a
            f^b, sigma = c f^d [S/m], with f in GHz. For effects, the name begins with the kind and a colon:
            "region:trees.specific_attenuation".
        lower: Lower bound, in the unit of the field.
        upper: Upper bound, in the unit of the field.
        start: Value before calibration, in the unit of the field; it must be within the bounds.
        scale: "linear", or "log" for a parameter that spans decades and has a positive lower bound.
        at_lower: Length of the interval of the search space that maps to the value `lower`. With such an interval, a
            prior gives this value a non-zero probability.

    Raises:
        InputError: The field is unknown, the bounds and the start value are out of order, or one of these values is
            physically impossible.

    Example:
        >>> Parameter("walls.relative_permittivity", lower=1.5, upper=12.0, start=5.0).material
        'walls'
    """

    name: str
    lower: float
    upper: float
    start: float
    scale: Scale = "linear"
    at_lower: float = 0.0

    def __post_init__(self) -> None:
        split_name(self.name)
        bound = PARAMETER_BOUNDS[self.field]
        for value in (self.lower, self.upper):
            if value not in bound:
                raise InputError(
                    f"{self.name}: bounds = [{self.lower}, {self.upper}]: {value} must be {bound}"
                )
        if self.lower >= self.upper:
            fault = "equal" if self.lower == self.upper else "reversed"
            raise InputError(
                f"{self.name}: bounds = [{self.lower}, {self.upper}] are {fault}; the lower bound must be less than "
                "the upper bound; to fix a constant, state it in [materials] instead"
            )
        if not self.lower <= self.start <= self.upper:
            raise InputError(
                f"{self.name}: start = {self.start:g} is outside bounds = [{self.lower:g}, {self.upper:g}]; widen the "
                "bounds or change the start value"
            )
        if self.scale not in get_args(Scale):
            raise InputError(
                f"{self.name}: scale = {self.scale!r}: must be one of {', '.join(get_args(Scale))}"
            )
        if self.scale == "log" and self.lower <= 0:
            raise InputError(
                f"{self.name}: scale = 'log' with lower bound {self.lower:g}: the lower bound must be greater than 0, "
                "or the scale must be 'linear'"
            )

    @property
    def material(self) -> str:
        """The part of the name before the last dot: the material, or the kind and label of an effect."""
        return split_name(self.name)[0]

    @property
    def field(self) -> str:
        """The part of the name after the last dot."""
        return split_name(self.name)[1]

    @property
    def constant(self) -> str:
        """The material constant (one of `FIELDS`) that the parameter changes; for an effect, the field itself."""
        return CONSTANT_OF_FIELD.get(self.field, self.field)

    @property
    def is_effect(self) -> bool:
        """Whether the parameter belongs to an effect instead of a material."""
        return is_effect(self.name)


SCATTERING_SPREAD: Final = 0.25
"""Standard deviation of a Gaussian. If a scattering coefficient is 0 in the scene but its true value is not exactly 0,
the positive half of this Gaussian is its prior. Facades have scattering coefficients of 0.2 to 0.4 (V. Degli-Esposti et
al., IEEE Trans. Antennas and Propagation 55, 2007)."""


def fixed_constant(name: str, value: float, spread: float) -> Parameter | None:
    """A parameter for a constant that a study keeps fixed, with bounds at four standard deviations of the logarithm.

    A scattering coefficient of 0 is exactly 0 with a probability of one half. Otherwise, its prior is the positive half
    of a Gaussian distribution with the standard deviation `SCATTERING_SPREAD`. The result is None if the spread is 0,
    if the bounds are impossible, or if a constant other than a scattering coefficient is 0.

    Example:
        >>> fixed_constant("walls.thickness", 0.2, 0.1).upper
        0.298364939528...
        >>> fixed_constant("walls.scattering_coefficient", 0.0, 0.1).upper
        0.75
    """
    constant = split_name(name)[1]
    if constant == "scattering_coefficient" and value == 0.0 and spread > 0.0:
        # This length equals the integral of the half Gaussian, whose density is scaled to 1 at 0.
        return Parameter(name, 0.0, 3.0 * SCATTERING_SPREAD, 0.0, at_lower=SCATTERING_SPREAD * sqrt(pi / 2.0))
    bound, factor = PARAMETER_BOUNDS[constant], exp(4.0 * spread)
    # The range ends at the physical bound, such as 1 for a scattering coefficient.
    lower, upper = value / factor, min(value * factor, bound.upper)
    if value <= 0.0 or spread <= 0.0 or lower not in bound or upper not in bound or lower >= upper:
        return None
    return Parameter(name, lower, upper, value, "log")


def is_effect(name: str) -> bool:
    """Whether a parameter name refers to an effect.

    Example:
        >>> is_effect("region:trees.specific_attenuation"), is_effect("walls.thickness")
        (True, False)
        >>> is_effect("walls.roughness_mm")
        True
    """
    return _of_kind(name) or name.endswith(f".{ROUGHNESS}")


def _of_kind(name: str) -> bool:
    """Whether a name starts with a kind of effect."""
    kind, colon, _ = name.partition(":")
    return bool(colon) and kind in EFFECTS


def split_name(name: str) -> tuple[str, str]:
    """Split the name of a parameter into material and field at the last dot.

    Raises:
        InputError: The name lacks a material, or the field is unknown.

    Example:
        >>> split_name("block.7.thickness")
        ('block.7', 'thickness')
    """
    material, _, field = name.rpartition(".")
    allowed = EFFECTS[name.partition(":")[0]] if _of_kind(name) else (*CONSTANT_OF_FIELD, ROUGHNESS)
    if not material:
        raise InputError(
            f"parameter {name!r}: must consist of a material and a field, such as 'walls.relative_permittivity'"
        )
    if field not in allowed:
        raise InputError(f"parameter {name!r}: no field {field!r}; {did_you_mean(field, allowed)}")
    return material, field


def start_value(
    name: str,
    start: float | str | None,
    base: Mapping[str, Material],
    frequency: float,
    laws: Mapping[str, ItuLaw] | None = None,
) -> float:
    """Determine the start value of a parameter of a scene, in the unit of the field.

    Args:
        name: Material and field, such as "walls.relative_permittivity".
        start: A value in the unit of the field; a name such as "itu:concrete" or "itu:concrete@P.2040-1" for the ITU-R
            P.2040 value; or None for the value in the scene.
        base: The materials of the scene by name.
        frequency: Frequency [Hz] at which the ITU-R laws are evaluated.
        laws: Laws of materials by name. The constants of other materials do not depend on frequency.

    Raises:
        InputError: The scene lacks the material, the field has no effect with the scattering pattern of the material,
            the start value is not finite, or ITU-R P.2040 does not cover the material at this frequency.

    Example:
        >>> walls = {"walls": Material(5.0, 0.1, 0.3)}
        >>> start_value("walls.relative_permittivity", "itu:brick", walls, 4e9)
        3.91
    """
    material, field = split_name(name)
    check_material(name, base)
    pattern = base[material].scattering_pattern
    if field in _PATTERN_FIELDS and field not in SCATTERING_PATTERNS[pattern]:
        raise InputError(
            f"parameter {name!r} has no effect: the scattering pattern of {material!r} is {pattern!r}"
        )
    if start is None and field in FIELDS:
        return float(getattr(base[material], field))
    if start is None:
        return _coefficient((laws or {}).get(material) or frequency_independent_law(base[material]), field)
    if isinstance(start, str):
        return itu_start(name, start, frequency)
    if isinstance(start, bool) or not isfinite(start):
        raise InputError(f"{name}: start = {start!r}: must be a finite number or 'itu:NAME'")
    return float(start)


def itu_start(name: str, start: str, frequency: float, key: str = "start") -> float:
    """Look up the ITU-R P.2040 value for text such as "itu:concrete@P.2040-1", in the unit of the field.

    Messages name the `key` of the study that states the value.

    Raises:
        InputError: The text does not have this form, ITU-R P.2040 does not specify the field, or ITU-R P.2040 does not
            cover the material at this frequency.
    """
    field = split_name(name)[1]
    if is_effect(name):
        raise InputError(
            f"{name}: {start!r}: ITU-R P.2040 specifies only materials, not effects; give a number"
        )
    if not start.startswith(_ITU_PREFIX):
        raise InputError(
            f"{name}: {key} = {start!r}: must be a number or 'itu:NAME', such as 'itu:concrete@P.2040-1'"
        )
    if CONSTANT_OF_FIELD.get(field) not in LAWS:
        raise InputError(f"{name}: {key} = {start!r}: ITU-R P.2040 does not specify {field}; give a number")
    itu_name, _, revision = start.removeprefix(_ITU_PREFIX).partition("@")
    try:
        if field not in FIELDS:
            return _coefficient(itu_law(itu_name, frequency, revision or DEFAULT_REVISION), field)
        material = itu_material(itu_name, frequency, revision=revision or DEFAULT_REVISION)
    except InputError as error:
        raise InputError(f"{name}: {key} = {start!r}: {error}") from None
    return float(getattr(material, field))


def _coefficient(law: ItuLaw, field: str) -> float:
    """The coefficient of a law that the field `itu_a`, `itu_b`, `itu_c` or `itu_d` names."""
    return float(getattr(law, field.removeprefix("itu_")))


def check_material(name: str, materials: Collection[str]) -> None:
    """Raise an error if a parameter belongs to a material that is not in the scene.

    Raises:
        InputError: The material is not in the scene. The message suggests the most similar name.
    """
    material = split_name(name)[0]
    if material not in materials:
        raise InputError(
            f"parameter {name!r}: the scene has no material {material!r}; {did_you_mean(material, materials)}"
        )


class PowerLaw(NamedTuple):
    """Values [...] of a power law s f^e, and the derivatives [...] of these values.

    Attributes:
        value: The value.
        by_scale: Derivative of the value with respect to s.
        by_exponent: Derivative of the value with respect to e.
    """

    value: NDArray[np.float64]
    by_scale: NDArray[np.float64]
    by_exponent: NDArray[np.float64]


def power_law(scale: NDArray[np.float64], exponent: NDArray[np.float64], frequency: float) -> PowerLaw:
    """Evaluate s f^e, with f in GHz, for scales s [...] and exponents e [...] at one frequency [Hz]."""
    frequency_ghz = frequency / 1e9
    power = frequency_ghz**exponent
    value = scale * power  # ITU-R P.2040-1 eq. 58 and 59
    return PowerLaw(value, by_scale=power, by_exponent=value * log(frequency_ghz))


def check_law(
    material: str,
    constant: str,
    scales: Iterable[float],
    exponents: Iterable[float],
    frequencies: Iterable[float],
) -> None:
    """Raise an error if bounds of a law s f^e allow an impossible constant at any of the carriers [Hz].

    A power law is monotonic in both coefficients, so only the corners of the bounds are checked. A fixed coefficient
    has a single value.

    Raises:
        InputError: A value of s f^e is outside the physical bounds of the constant.
    """
    scale_name, exponent_name = LAWS[constant]
    for frequency, scale, exponent in product(frequencies, scales, exponents):
        value = float(power_law(np.array(scale), np.array(exponent), frequency).value)
        if value not in BOUNDS[constant]:
            raise InputError(
                f"{material}.{scale_name} = {scale:g} with {exponent_name} = {exponent:g} results in {constant} = "
                f"{value:.4g} at {frequency / 1e9:g} GHz, must be {BOUNDS[constant]}; narrow the bounds"
            )
