"""Settings of a trace, and the antennas at both ends of its links."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from math import isfinite
from typing import Final, Literal

from calibray.errors import InputError
from calibray.support.messages import shortened
from calibray.tracing.gain_table import is_gain_file, read_gain_table

PATTERNS: Final = ("iso", "dipole", "hw_dipole", "tr38901")
POLARIZATIONS: Final = ("V", "H", "VH", "cross")
LARGEST_ARRAY: Final = 64
"""Maximum number of rows or columns of an array."""
LARGEST_SPACING: Final = 10.0
"""Maximum spacing between the antennas of an array [wavelengths]."""

AUTO: Final = "auto"
"""Value of `samples` that lets the tracer choose the number of rays."""
RAYS_PER_ROUND: Final = 250_000
"""Number of rays per launch for traces in which rays are added in rounds."""

RANGES: Final = {"max_depth": (0, 100), "samples": (1, 10**12), "seed": (0, 2**32 - 1)}
"""Allowed ranges of settings; no machine can trace more rays or interactions, and Sionna RT's seeds have 32 bits."""


@dataclass(frozen=True)
class TraceSettings:
    """Settings of the tracer, with the same meaning as in Sionna RT.

    Attributes:
        max_depth: Maximum number of interactions of a path, 0 to 100.
        line_of_sight: Find the direct path.
        specular_reflection: Follow specular reflections.
        refraction: Follow transmission through surfaces.
        diffraction: Follow first-order diffraction at wedges.
        edge_diffraction: Also follow diffraction at free edges.
        diffraction_lit_region: Keep diffracted paths to receivers in the lit region as well as those in the shadow
            region.
        diffuse_reflection: Follow diffuse reflections.
        samples: Rays per transmitter, 1 to 10^12. With "auto", rays are added in rounds until path loss converges;
            "auto" cannot be combined with diffuse reflection.
        seed: Seed of the tracer's random numbers, 0 to 2^32 - 1.

    Raises:
        InputError: A number is out of range, a switch is not true or false, or "auto" is used with diffuse reflection.
    """

    max_depth: int = 3
    line_of_sight: bool = True
    specular_reflection: bool = True
    refraction: bool = False
    diffraction: bool = False
    edge_diffraction: bool = False
    diffraction_lit_region: bool = True
    diffuse_reflection: bool = False
    samples: int | Literal["auto"] = 1_000_000
    seed: int = 1

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name not in RANGES:
                if not isinstance(value, bool):
                    raise InputError(f"trace.{name} = {shortened(repr(value))}: must be true or false")
                continue
            if name == "samples" and value == AUTO:
                continue
            least, most = RANGES[name]
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise InputError(
                    f"trace.{name} = {shortened(repr(value))}: must be a whole number from {least} to {most:,}"
                    + (", or 'auto'" if name == "samples" else "")
                )

        if self.diffuse_reflection and self.adaptive:
            raise InputError(
                "trace.samples = 'auto' cannot be combined with diffuse reflection, which is an average over rays; "
                "give a number, or set diffuse_reflection = false"
            )

    @property
    def adaptive(self) -> bool:
        """Whether rays are added until path loss converges."""
        return self.samples == AUTO

    @property
    def rays(self) -> int:
        """Number of rays per transmitter, or per launch if rays are added in rounds."""
        return RAYS_PER_ROUND if self.samples == "auto" else self.samples

    def record(self) -> dict[str, int | bool | str]:
        """The settings by name, for files and digests."""
        return asdict(self)


@dataclass(frozen=True)
class Antenna:
    """An antenna with a Sionna RT pattern or measured gains.

    Attributes:
        pattern: "iso", "dipole", "hw_dipole" or "tr38901", or a gain file (see `read_gain_table`).
        polarization: "V", "H", or dual "VH" or "cross". In every direction of the antenna's frame, the field has this
            polarization (3GPP TR 38.901, eq. 7.3-4/5) and the gain of the pattern.
        orientation: Rotation about z, y and x [rad]: yaw, pitch, roll.
        rows: Number of rows, along the z axis, of a planar array of these antennas; one signal feeds all antennas.
        columns: Number of columns of the array, along its y axis.
        spacing: Horizontal and vertical spacing of the antennas of the array [wavelengths].

    Raises:
        InputError: The pattern or polarization is unknown, the orientation is not three numbers, or the array size is
            invalid.
    """

    pattern: str = "iso"
    polarization: str = "V"
    orientation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rows: int = 1
    columns: int = 1
    spacing: tuple[float, float] = (0.5, 0.5)

    def __post_init__(self) -> None:
        if self.pattern not in PATTERNS and not (
            isinstance(self.pattern, str) and is_gain_file(self.pattern)
        ):
            raise InputError(
                f"antenna pattern = {self.pattern!r}: must be one of {', '.join(PATTERNS)}, or a file of gains, "
                "such as 'horn.csv'"
            )
        if self.polarization not in POLARIZATIONS:
            raise InputError(
                f"antenna polarization = {self.polarization!r}: must be one of {', '.join(POLARIZATIONS)}"
            )
        try:
            angles = tuple(float(angle) for angle in self.orientation)
        except (TypeError, ValueError):
            angles = ()
        if len(angles) != 3 or not all(isfinite(angle) for angle in angles):
            raise InputError(
                f"antenna orientation = {self.orientation!r}: must be three angles [rad]: yaw, pitch, roll"
            )
        object.__setattr__(self, "orientation", angles)
        for name in ("rows", "columns"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= LARGEST_ARRAY:
                raise InputError(
                    f"antenna {name} = {shortened(repr(value))}: must be a whole number, 1 to {LARGEST_ARRAY}"
                )
        try:
            horizontal, vertical = (float(distance) for distance in self.spacing)
        except (TypeError, ValueError):
            horizontal = vertical = 0.0
        if not (0 < horizontal <= LARGEST_SPACING and 0 < vertical <= LARGEST_SPACING):
            raise InputError(
                f"antenna spacing = {self.spacing!r}: must be two distances [wavelengths], horizontal and vertical, "
                f"greater than 0 and at most {LARGEST_SPACING:g}"
            )
        object.__setattr__(self, "spacing", (horizontal, vertical))

    @property
    def is_array(self) -> bool:
        """Whether this antenna is an array of several antennas."""
        return self.rows * self.columns > 1

    @property
    def ports(self) -> int:
        """Number of ports: 2 for a dual-polarized antenna, otherwise 1."""
        return 2 if self.polarization in ("VH", "cross") else 1

    @property
    def gain_file(self) -> str | None:
        """The gain file, or None."""
        return self.pattern if is_gain_file(self.pattern) else None

    def record(self) -> dict[str, object]:
        """The attributes by name, for digests; a gain table is represented by its content, not its file name."""
        record: dict[str, object] = asdict(self)
        if self.gain_file is not None:
            record["pattern"] = read_gain_table(self.gain_file).digest()
        if not self.is_array:
            for name in ("rows", "columns", "spacing"):
                del record[name]
        return record


def as_antenna(value: Antenna | Mapping[str, object] | None, name: str = "antenna") -> Antenna:
    """Make an antenna from a mapping of its attributes or from None (the default); an antenna is returned unchanged.

    Error messages refer to the antenna as `name`.

    Raises:
        InputError: The value is not an antenna, a mapping or None, or an attribute is unknown or invalid.
    """
    if value is None:
        return Antenna()
    if isinstance(value, Antenna):
        return value
    if not isinstance(value, Mapping):
        raise InputError(
            f"{name}: is {shortened(repr(value))}, but must be an Antenna or its attributes, such as "
            '{"pattern": "dipole"}'
        )
    unknown = set(value) - {field.name for field in fields(Antenna)}
    if unknown:
        known = ", ".join(field.name for field in fields(Antenna))
        raise InputError(f"{name}: unknown key {min(unknown, key=str)!r}; known: {known}")
    return Antenna(**value)  # type: ignore[arg-type]
