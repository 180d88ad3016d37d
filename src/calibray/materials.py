"""Radio materials: the constants of a surface, and the ITU-R P.2040 laws for the constants of named materials.

Below 100 GHz, P.2040-1 differs from the later revisions (relative permittivity 5.31 instead of 5.24 for concrete, 6.27
instead of 6.31 for glass). P.2040-2 and -3 have the same Table 3. P.2040-4 keeps the rows of P.2040-3, and adds new
materials and rows above 100 GHz. Sionna RT 2.2 follows P.2040-4; below 100 GHz, the default "P.2040-3" gives the same
values.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from math import inf, isfinite
from numbers import Real
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.support.messages import did_you_mean

FREQUENCIES: Final = (1e6, 1e12)
"""Range of valid carrier frequencies [Hz]; a value outside this range was probably given in MHz or GHz."""


def check_frequency(frequency: object, name: str = "frequency") -> float:
    """Check a carrier frequency [Hz] and convert it to a float; error messages call the frequency `name`.

    Raises:
        InputError: The frequency is not a number in the range `FREQUENCIES`.

    Example:
        >>> check_frequency(28_500_000_000)
        28500000000.0
    """
    lowest, highest = FREQUENCIES
    if isinstance(frequency, bool) or not (
        isinstance(frequency, Real) and lowest <= float(frequency) <= highest
    ):
        raise InputError(
            f"{name} = {frequency!r}: must be from {lowest:g} to {highest:g} Hz; write 28.5 GHz as 28.5e9"
        )
    return float(frequency)


FIELDS: Final = (
    "relative_permittivity",
    "conductivity",
    "thickness",
    "scattering_coefficient",
    "xpd_coefficient",
    "alpha_r",
    "alpha_i",
    "lambda_",
)
"""The numeric fields of a `Material`, in the order of the columns of a constants matrix."""

SCALAR_CONSTANTS: Final = FIELDS[:5]
"""The fields that a Sionna scene file can contain; Sionna RT stores them in single precision."""


@dataclass(frozen=True)
class Bound:
    """The physically possible range of a field's values.

    Attributes:
        lower: Smallest possible value, in the field's unit.
        upper: Largest possible value, in the field's unit.
        unit: Unit of the field; "1" if the field is dimensionless.
        open_below: Whether `lower` itself is excluded.
    """

    lower: float
    upper: float
    unit: str
    open_below: bool = False

    def __contains__(self, value: float) -> bool:
        above_lower = value > self.lower if self.open_below else value >= self.lower
        return isfinite(value) and above_lower and value <= self.upper

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        if self.upper == inf:
            comparison = "greater than" if self.open_below else "not below"
            return f"a finite number {comparison} {self.lower:g}{unit}"
        return f"a number in [{self.lower:g}, {self.upper:g}]{unit}"


BOUNDS: Final[Mapping[str, Bound]] = MappingProxyType(
    {
        "relative_permittivity": Bound(1.0, inf, "1"),
        "conductivity": Bound(0.0, inf, "S/m"),
        "thickness": Bound(0.0, inf, "m", open_below=True),
        "scattering_coefficient": Bound(0.0, 1.0, "1"),
        "xpd_coefficient": Bound(0.0, 1.0, "1"),
        "alpha_r": Bound(1.0, 126.0, "1"),
        "alpha_i": Bound(1.0, 126.0, "1"),
        "lambda_": Bound(0.0, 1.0, "1"),
    }
)
"""Bounds of each field, as in Sionna RT, except that the thickness must be greater than 0 and exponents at most 126. An
exponent of 127 would give infinite or undefined gains."""

SCATTERING_PATTERNS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {"lambertian": (), "directive": ("alpha_r",), "backscattering": ("alpha_r", "alpha_i", "lambda_")}
)
"""Scattering patterns, each with the fields on which the pattern depends."""


@dataclass(frozen=True)
class Material:
    """The radio constants of a surface, which is modelled as a slab of a homogeneous, non-magnetic medium.

    Attributes:
        relative_permittivity: Real part of the relative permittivity [1]; at least 1.
        conductivity: Conductivity [S/m], at least 0.
        thickness: Thickness of the slab [m], greater than 0.
        scattering_coefficient: Scattering coefficient S [1], in [0, 1]: the fraction of the reflected amplitude that is
            scattered diffusely.
        xpd_coefficient: Cross-polarization discrimination coefficient K_x [1], in [0, 1], of diffusely scattered
            fields.
        scattering_pattern: "lambertian", "directive" or "backscattering" (Degli-Esposti et al., IEEE Trans.
            Antennas and Propagation 55(1), 2007).
        alpha_r: Exponent [1] of the lobe around the specular direction, 1 to 126; for Sionna RT, the exponent is
            rounded.
        alpha_i: Exponent [1] of the lobe back towards the source, 1 to 126; for Sionna RT, the exponent is rounded.
        lambda_: Fraction [1], in [0, 1], of the diffuse energy that is in the lobe around the specular direction.

    Raises:
        InputError: A constant is not a finite number within `BOUNDS`, or the pattern is unknown.

    Example:
        >>> Material(relative_permittivity=5.24, conductivity=0.14, thickness=0.3).scattering_coefficient
        0.0
    """

    relative_permittivity: float
    conductivity: float
    thickness: float
    scattering_coefficient: float = 0.0
    xpd_coefficient: float = 0.0
    scattering_pattern: str = "lambertian"
    alpha_r: float = 1.0
    alpha_i: float = 1.0
    lambda_: float = 1.0

    def __post_init__(self) -> None:
        for name in FIELDS:
            object.__setattr__(self, name, _within_bounds(name, getattr(self, name)))
        if self.scattering_pattern not in SCATTERING_PATTERNS:
            remedy = did_you_mean(self.scattering_pattern, SCATTERING_PATTERNS)
            raise InputError(f"scattering_pattern = {self.scattering_pattern!r}: unknown pattern, {remedy}")


def _within_bounds(name: str, value: Any) -> float:
    """Convert a field's value to a float; if this fails, an `InputError` states the field, value and bound."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if isinstance(value, bool | str) or number not in BOUNDS[name]:
        raise InputError(f"{name} = {value!r}: must be {BOUNDS[name]}")
    return number


def constants_matrix(materials: Mapping[str, Material]) -> NDArray[np.float64]:
    """The constants of materials as a matrix [materials, fields], in the order and units of `FIELDS`.

    Example:
        >>> constants_matrix({"walls": Material(5.24, 0.14, 0.3)})[0, :3].tolist()
        [5.24, 0.14, 0.3]
    """
    rows = [[getattr(material, name) for name in FIELDS] for material in materials.values()]
    return np.array(rows, dtype=np.float64).reshape(-1, len(FIELDS))


class ItuLaw(NamedTuple):
    """One row of ITU-R P.2040 Table 3: eps_r = a f^b and sigma = c f^d [S/m], with f in GHz.

    Attributes:
        lower: Lower end of the frequency range [GHz], inclusive.
        upper: Upper end of the frequency range [GHz], inclusive.
        a: Relative permittivity [1] at 1 GHz.
        b: Exponent [1] of the relative permittivity.
        c: Conductivity [S/m] at 1 GHz.
        d: Exponent [1] of the conductivity.
    """

    lower: float
    upper: float
    a: float
    b: float
    c: float
    d: float


def frequency_independent_law(material: Material) -> ItuLaw:
    """The law of a material with the same constants at all frequencies."""
    return ItuLaw(0, inf, material.relative_permittivity, 0.0, material.conductivity, 0.0)


def law_with_stated(law: ItuLaw, material: Material, stated: Collection[str]) -> ItuLaw:
    """The law of a material, with explicit values, independent of frequency, for the fields in `stated`."""
    # P.2040: permittivity a f^b, conductivity c f^d.
    if "relative_permittivity" in stated:
        law = law._replace(a=material.relative_permittivity, b=0.0)
    return law._replace(c=material.conductivity, d=0.0) if "conductivity" in stated else law


_Table = Mapping[str, tuple[ItuLaw, ...]]


def _table(rows: Mapping[str, tuple[tuple[float, ...], ...]]) -> _Table:
    return MappingProxyType({name: tuple(ItuLaw(*row) for row in laws) for name, laws in rows.items()})


def _extended(base: _Table, rows: Mapping[str, tuple[tuple[float, ...], ...]]) -> _Table:
    """Append `rows` to the rows of `base`; where their frequency ranges overlap, the rows of `base` apply."""
    return _table({name: (*base.get(name, ()), *rows.get(name, ())) for name in {**base, **rows}})


_P2040_1: Final = _table(
    {
        "vacuum": ((0.001, 100, 1.0, 0, 0.0, 0),),
        "concrete": ((1, 100, 5.31, 0, 0.0326, 0.8095),),
        "brick": ((1, 10, 3.75, 0, 0.038, 0),),
        "plasterboard": ((1, 100, 2.94, 0, 0.0116, 0.7076),),
        "wood": ((0.001, 100, 1.99, 0, 0.0047, 1.0718),),
        "glass": ((0.1, 100, 6.27, 0, 0.0043, 1.1925),),
        "ceiling_board": ((1, 100, 1.50, 0, 0.0005, 1.1634),),
        "chipboard": ((1, 100, 2.58, 0, 0.0217, 0.7800),),
        "floorboard": ((50, 100, 3.66, 0, 0.0044, 1.3515),),
        "metal": ((1, 100, 1.0, 0, 1e7, 0),),
        "very_dry_ground": ((1, 10, 3.0, 0, 0.00015, 2.52),),
        "medium_dry_ground": ((1, 10, 15.0, -0.1, 0.035, 1.63),),
        "wet_ground": ((1, 10, 30.0, -0.4, 0.15, 1.30),),
    }
)
_P2040_2: Final = _table(
    {
        "vacuum": ((0.001, 100, 1.0, 0, 0.0, 0),),
        "concrete": ((1, 100, 5.24, 0, 0.0462, 0.7822),),
        "brick": ((1, 40, 3.91, 0, 0.0238, 0.16),),
        "plasterboard": ((1, 100, 2.73, 0, 0.0085, 0.9395),),
        "wood": ((0.001, 100, 1.99, 0, 0.0047, 1.0718),),
        "glass": ((0.1, 100, 6.31, 0, 0.0036, 1.3394), (220, 450, 5.79, 0, 0.0004, 1.658)),
        "ceiling_board": ((1, 100, 1.48, 0, 0.0011, 1.0750), (220, 450, 1.52, 0, 0.0029, 1.029)),
        "chipboard": ((1, 100, 2.58, 0, 0.0217, 0.7800),),
        "plywood": ((1, 40, 2.71, 0, 0.33, 0),),
        "marble": ((1, 60, 7.074, 0, 0.0055, 0.9262),),
        "floorboard": ((50, 100, 3.66, 0, 0.0044, 1.3515),),
        "metal": ((1, 100, 1.0, 0, 1e7, 0),),
        "very_dry_ground": ((1, 10, 3.0, 0, 0.00015, 2.52),),
        "medium_dry_ground": ((1, 10, 15.0, -0.1, 0.035, 1.63),),
        "wet_ground": ((1, 10, 30.0, -0.4, 0.15, 1.30),),
    }
)
_P2040_4: Final = _extended(
    _P2040_2,
    {
        "concrete": ((110, 330, 5.17, 0, 0.0145, 1.0900),),
        "brick": ((110, 330, 4.15, 0, 0.0006, 1.5712),),
        "plasterboard": ((110, 330, 2.56, 0, 0.0001, 1.7799), (100, 400, 2.65, 0, 0.0002, 1.598)),
        "wood": ((110, 330, 1.82, 0, 0.0040, 1.0761), (100, 400, 2.1183, 0, 0.0055, 1.1113)),
        "glass": ((100, 400, 6.5767, 0, 0.0012, 1.4697),),
        "clear_acrylic": ((110, 330, 2.58, 0, 0.0001, 1.6524),),
        "ceiling_board": ((100, 400, 1.2567, 0, 0.00013, 1.454),),
        "chipboard": ((100, 200, 2.16, 0, 0.0023, 1.359),),
        "plywood": ((110, 330, 1.94, 0, 0.0067, 0.9982), (100, 400, 2.17, 0, 0.0063, 1.045)),
        "marble": ((110, 330, 7.94, 0, 0.0001, 1.7330), (100, 400, 8.62, 0, 0.0027, 1.15)),
        "floorboard": (
            (220, 300, 5.27, 0, 2.22e-17, 7.3413),
            (300, 400, 5.27, 0, 0.0003, 2.0298),
            (400, 450, 5.27, 0, 49.8726, 0),
            (100, 400, 3.1575, 0, 0.001675, 1.32775),
        ),
        "vinyl_tile": ((1, 40, 3.62, 0, 0.0051, 0.8422),),
        "carpet_tile": ((1, 40, 2.08, 0, 0.0009, 0.8200),),
        "asphalt_concrete": ((1, 40, 4.83, 0, 0.0108, 1.3969),),
    },
)

ITU_MATERIALS: Final[Mapping[str, _Table]] = MappingProxyType(
    {"P.2040-1": _P2040_1, "P.2040-2": _P2040_2, "P.2040-3": _P2040_2, "P.2040-4": _P2040_4}
)
"""ITU-R P.2040 Table 3 by revision and material; where frequency ranges overlap, the first row applies, as in Sionna
RT."""

DEFAULT_REVISION: Final = "P.2040-3"


def itu_material(
    name: str, frequency: float, thickness: float = 0.1, revision: str = DEFAULT_REVISION, **scattering: Any
) -> Material:
    """Make a material from ITU-R P.2040 Table 3 at a given frequency.

    Args:
        name: Name of the material as in Sionna RT, for instance "concrete" or "very_dry_ground".
        frequency: Frequency [Hz], within the range of the material's law; the limits are included.
        thickness: Thickness of the slab [m]; P.2040 specifies no thickness, so the default is that of Sionna RT, 0.1 m.
        revision: Revision of the recommendation, a key of `ITU_MATERIALS`.
        **scattering: Other fields of the `Material`, for instance ``scattering_coefficient=0.3``.

    Returns:
        The material, with the law's permittivity [1] and conductivity [S/m].

    Raises:
        InputError: The revision or the name is unknown, the law does not cover the frequency, or a constant
            is out of bounds.

    Example:
        >>> itu_material("concrete", frequency=4e9, revision="P.2040-1").relative_permittivity
        5.31
    """
    if stated := scattering.keys() & {"relative_permittivity", "conductivity"}:
        raise InputError(f"{min(stated)}: follows from ITU-R P.2040; use Material to set it")
    law = itu_law(name, frequency, revision)
    frequency_ghz = frequency / 1e9
    return Material(
        relative_permittivity=law.a * frequency_ghz**law.b,  # eps_r = a f^b, ITU-R P.2040-1 eq. 58
        conductivity=law.c * frequency_ghz**law.d,  # sigma = c f^d, ITU-R P.2040-1 eq. 59
        thickness=thickness,
        **scattering,
    )


def itu_law(name: str, frequency: float, revision: str = DEFAULT_REVISION) -> ItuLaw:
    """Find the row of ITU-R P.2040 Table 3 for a material at a frequency [Hz]; materials are named as in Sionna RT.

    Raises:
        InputError: The revision or the name is unknown, or no law covers the frequency.

    Example:
        >>> itu_law("concrete", 4e9).d
        0.7822
    """
    if revision not in ITU_MATERIALS:
        raise InputError(f"revision = {revision!r}: unknown, {did_you_mean(revision, ITU_MATERIALS)}")
    frequency, table = check_frequency(frequency), ITU_MATERIALS[revision]
    if name not in table:
        others = [other for other in ITU_MATERIALS if name in ITU_MATERIALS[other]]
        remedy = f"it is in {', '.join(others)}" if others else did_you_mean(name, table)
        raise InputError(f"{name!r} is not a material of ITU-R {revision}: {remedy}")
    for law in table[name]:
        if law.lower <= frequency / 1e9 <= law.upper:
            return law
    ranges = " and ".join(f"{law.lower:g} to {law.upper:g} GHz" for law in table[name])
    raise InputError(
        f"ITU-R {revision} covers {name!r} at {ranges}, not at {frequency / 1e9:g} GHz: "
        "give relative_permittivity and conductivity instead"
    )
