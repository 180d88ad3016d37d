"""Radio materials: the constants of a surface, and the ITU-R P.2040 laws that give them by name and frequency."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite
from typing import Final

from calibray.errors import InputError

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


@dataclass(frozen=True)
class Bound:
    """The physically possible range of one field.

    Attributes:
        lower: Smallest possible value, in the field's unit.
        upper: Largest possible value, in the field's unit.
        unit: Unit of the field, "1" for a pure number.
        open_below: Whether `lower` itself is excluded.
    """

    lower: float
    upper: float
    unit: str
    open_below: bool = False

    def __contains__(self, value: float) -> bool:
        return (
            isfinite(value)
            and (self.lower < value or value == self.lower and not self.open_below)
            and value <= self.upper
        )

    def __str__(self) -> str:
        comparison = "greater than" if self.open_below else "at least"
        unit = "" if self.unit == "1" else f" {self.unit}"
        if self.upper == inf:
            return f"a finite number {comparison} {self.lower:g}{unit}"
        return f"in [{self.lower:g}, {self.upper:g}]{unit}"


BOUNDS: Final = {
    "relative_permittivity": Bound(1.0, inf, "1"),
    "conductivity": Bound(0.0, inf, "S/m"),
    "thickness": Bound(0.0, inf, "m", open_below=True),
    "scattering_coefficient": Bound(0.0, 1.0, "1"),
    "xpd_coefficient": Bound(0.0, 1.0, "1"),
    "alpha_r": Bound(1.0, inf, "1"),
    "alpha_i": Bound(1.0, inf, "1"),
    "lambda_": Bound(0.0, 1.0, "1"),
}
"""The physical bounds of each field; those that Sionna RT enforces, and a slab that is not empty."""

SCATTERING_PATTERNS: Final = {
    "lambertian": (),
    "directive": ("alpha_r",),
    "backscattering": ("alpha_r", "alpha_i", "lambda_"),
}
"""The scattering patterns by name, each with the fields that shape it."""


@dataclass(frozen=True)
class Material:
    """The radio constants of a surface, a slab of one homogeneous non-magnetic medium.

    Attributes:
        relative_permittivity: Real part of the relative permittivity [1], at least 1.
        conductivity: Conductivity [S/m], at least 0.
        thickness: Thickness of the slab [m], greater than 0.
        scattering_coefficient: Scattering coefficient S [1]: the share of the reflected amplitude that leaves
            diffusely, in [0, 1].
        xpd_coefficient: Cross-polarization discrimination coefficient K_x [1] of the diffuse field, in [0, 1].
        scattering_pattern: "lambertian", "directive" or "backscattering" (Degli-Esposti et al., IEEE Transactions on
            Antennas and Propagation, 2007).
        alpha_r: Width exponent [1] of the lobe around the specular direction, at least 1; Sionna RT takes whole
            numbers only.
        alpha_i: Width exponent [1] of the lobe back towards the source, at least 1; whole numbers for Sionna RT.
        lambda_: Share [1] of the diffuse energy in the lobe around the specular direction, in [0, 1].

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
            object.__setattr__(self, name, _checked(name, getattr(self, name)))
        if self.scattering_pattern not in SCATTERING_PATTERNS:
            raise InputError(
                f"scattering_pattern = {self.scattering_pattern!r}: must be one of {', '.join(SCATTERING_PATTERNS)}"
            )


def _checked(name: str, value: object) -> float:
    """The value of a field as a float, or an `InputError` that names field, value and bound."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(f"{name} = {value!r}: must be {BOUNDS[name]}") from None
    if isinstance(value, bool | str) or number not in BOUNDS[name]:
        raise InputError(f"{name} = {value!r}: must be {BOUNDS[name]}")
    return number
