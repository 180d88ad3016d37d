"""Free parameters: the constants that a calibration may change, and the way from vectors to materials."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.materials import (
    BOUNDS,
    DEFAULT_REVISION,
    FIELDS,
    SCATTERING_PATTERNS,
    Material,
    constants,
    itu_material,
)
from calibray.spelling import did_you_mean

Scale = Literal["linear", "log"]

_ITU_PREFIX: Final = "itu:"
_ITU_FIELDS: Final = ("relative_permittivity", "conductivity")
_PATTERN_FIELDS: Final = ("alpha_r", "alpha_i", "lambda_")


@dataclass(frozen=True)
class Parameter:
    """One calibrated number: a field of a material, with its bounds and its start.

    Attributes:
        name: Material and field, joined by the last dot: "walls.relative_permittivity".
        lower: Lower bound, in the field's unit.
        upper: Upper bound, in the field's unit.
        start: Value before calibration, within the bounds, in the field's unit.
        scale: "linear", or "log" for a constant that spans decades; then `lower` must be greater than 0.

    Raises:
        InputError: The field is unknown, or bounds or start are out of order or outside physics.

    Example:
        >>> Parameter("walls.relative_permittivity", lower=1.5, upper=12.0, start=5.0).material
        'walls'
    """

    name: str
    lower: float
    upper: float
    start: float
    scale: Scale = "linear"

    def __post_init__(self) -> None:
        split_name(self.name)
        bound = BOUNDS[self.field]
        for value in (self.lower, self.upper):
            if value not in bound:
                raise InputError(
                    f"{self.name}: bounds = [{self.lower}, {self.upper}]: {value} must be {bound}"
                )
        if self.lower >= self.upper:
            fault = "equal" if self.lower == self.upper else "reversed"
            raise InputError(
                f"{self.name}: bounds = [{self.lower}, {self.upper}] are {fault}; the lower must be less "
                "than the upper; to fix a constant, give it under [materials] instead"
            )
        if not self.lower <= self.start <= self.upper:
            raise InputError(
                f"{self.name}: start = {self.start:g} lies outside bounds = [{self.lower:g}, {self.upper:g}];"
                " widen them or give another start"
            )
        if self.scale not in get_args(Scale):
            raise InputError(
                f"{self.name}: scale = {self.scale!r}: must be one of {', '.join(get_args(Scale))}"
            )
        if self.scale == "log" and self.lower <= 0:
            raise InputError(
                f"{self.name}: scale = 'log' with lower bound {self.lower:g}: the lower bound must be "
                "greater than 0, or the scale 'linear'"
            )

    @property
    def material(self) -> str:
        """The material's name."""
        return split_name(self.name)[0]

    @property
    def field(self) -> str:
        """The field's name, one of `FIELDS`."""
        return split_name(self.name)[1]


@dataclass(frozen=True)
class Parameters:
    """The parameters of a study, in the order of a candidate's components.

    Attributes:
        items: The parameters, at least one.

    Raises:
        InputError: There is none, or a name stands twice.

    Example:
        >>> wall = Parameter("walls.relative_permittivity", lower=1.0, upper=11.0, start=5.0)
        >>> parameters = Parameters((wall,))
        >>> parameters.materials([7.0], {"walls": Material(5.0, 0.1, 0.3)})["walls"].relative_permittivity
        7.0
        >>> parameters.to_unit([[6.0]]).tolist()
        [[0.5]]
    """

    items: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "items", tuple(self.items))
        if not self.items:
            raise InputError('parameters: none given; name at least one, as "walls.relative_permittivity"')
        if twice := [name for index, name in enumerate(self.names) if name in self.names[:index]]:
            raise InputError(f"parameters: {twice[0]!r} stands twice; remove one")

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.items)

    @property
    def names(self) -> tuple[str, ...]:
        """The names [parameters]."""
        return tuple(parameter.name for parameter in self.items)

    @property
    def lower(self) -> NDArray[np.float64]:
        """The lower bounds [parameters], in the fields' units."""
        return np.array([parameter.lower for parameter in self.items], dtype=np.float64)

    @property
    def upper(self) -> NDArray[np.float64]:
        """The upper bounds [parameters], in the fields' units."""
        return np.array([parameter.upper for parameter in self.items], dtype=np.float64)

    @property
    def start(self) -> NDArray[np.float64]:
        """The start values [parameters], in the fields' units."""
        return np.array([parameter.start for parameter in self.items], dtype=np.float64)

    @property
    def logarithmic(self) -> NDArray[np.bool_]:
        """Whether each parameter [parameters] is searched on a logarithmic scale."""
        return np.array([parameter.scale == "log" for parameter in self.items])

    def materials(self, candidate: ArrayLike, base: Mapping[str, Material]) -> dict[str, Material]:
        """The materials that a candidate describes.

        Args:
            candidate: Parameter values [parameters], in the fields' units.
            base: The scene's materials by name; what is no parameter stays as it is.

        Returns:
            All materials of `base`, in its order, with the candidate's values.

        Raises:
            InputError: The candidate has another length, a value is outside physics, or a material is
                unknown.
        """
        values = np.asarray(candidate, dtype=np.float64)
        if values.shape != (len(self),):
            raise InputError(
                f"candidate: shape {values.shape}, must be ({len(self)},), one value per parameter"
            )
        changes: dict[str, dict[str, float]] = {}
        for parameter, value in zip(self.items, values.tolist(), strict=True):
            _check_material(parameter.name, base)
            changes.setdefault(parameter.material, {})[parameter.field] = value
        return {name: replace(material, **changes.get(name, {})) for name, material in base.items()}

    def indices(self, materials: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where each parameter stands in a constants matrix [materials, fields].

        A pure replay scatters candidates with them: ``constants.at[..., rows, columns].set(candidates)``.

        Args:
            materials: The names of the matrix's rows, in order; its columns are `FIELDS`.

        Returns:
            The rows [parameters] and the columns [parameters].

        Raises:
            InputError: A parameter's material is not among them.
        """
        order = list(materials)
        for name in self.names:
            _check_material(name, order)
        rows = np.array([order.index(parameter.material) for parameter in self.items], dtype=np.int64)
        columns = np.array([FIELDS.index(parameter.field) for parameter in self.items], dtype=np.int64)
        return rows, columns

    def constants(self, candidates: ArrayLike, base: Mapping[str, Material]) -> NDArray[np.float64]:
        """The constants of the materials that candidates describe.

        Args:
            candidates: Parameter values [..., parameters], in the fields' units.
            base: The scene's materials by name, in the order of the rows.

        Returns:
            The constants [..., materials, fields], columns as `FIELDS`.

        Raises:
            InputError: The candidates have another length, or a parameter's material is unknown.
        """
        values = self._components(candidates)
        rows, columns = self.indices(list(base))
        matrix = constants(base)
        batch = np.broadcast_to(matrix, (*values.shape[:-1], *matrix.shape)).copy()
        batch[..., rows, columns] = values
        return batch

    def to_unit(self, candidates: ArrayLike) -> NDArray[np.float64]:
        """Candidates [..., parameters] scaled so that the bounds become 0 and 1.

        Raises:
            InputError: The candidates have another length.
        """
        lower, span = self._scaled_bounds()
        return (self._scaled(self._components(candidates)) - lower) / span

    def from_unit(self, unit: ArrayLike) -> NDArray[np.float64]:
        """Candidates [..., parameters] from values in which the bounds are 0 and 1; never beyond the bounds.

        Raises:
            InputError: The values have another length.
        """
        lower, span = self._scaled_bounds()
        values = lower + self._components(unit) * span
        values[..., self.logarithmic] = np.exp(values[..., self.logarithmic])
        # Rounding of exp and log would otherwise leave the bounds by an ulp.
        return np.clip(values, self.lower, self.upper)

    def _components(self, values: ArrayLike) -> NDArray[np.float64]:
        array = np.asarray(values, dtype=np.float64)
        if array.ndim == 0 or array.shape[-1] != len(self):
            raise InputError(
                f"candidates: shape {array.shape}, must end in {len(self)}, one value per parameter"
            )
        return array

    def _scaled(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        scaled = values.copy()
        scaled[..., self.logarithmic] = np.log(values[..., self.logarithmic])
        return scaled

    def _scaled_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        lower = self._scaled(self.lower)
        return lower, self._scaled(self.upper) - lower


def split_name(name: str) -> tuple[str, str]:
    """Material and field of a parameter's name: everything before the last dot, and what follows it.

    Args:
        name: The name.

    Returns:
        The material's name and the field's.

    Raises:
        InputError: The name has no material, or the field is unknown.

    Example:
        >>> split_name("block.7.thickness")
        ('block.7', 'thickness')
    """
    material, _, field = name.rpartition(".")
    if not material:
        raise InputError(
            f"parameter {name!r}: must be a material and a field, as 'walls.relative_permittivity'"
        )
    if field not in FIELDS:
        raise InputError(f"parameter {name!r}: no field {field!r}; {did_you_mean(field, FIELDS)}")
    return material, field


def make_parameter(
    name: str,
    bounds: tuple[float, float],
    base: Mapping[str, Material],
    frequency: float,
    start: float | str | None = None,
    scale: Scale = "linear",
) -> Parameter:
    """A parameter of a scene, its start resolved.

    Args:
        name: Material and field, as "walls.relative_permittivity".
        bounds: Lower and upper bound, in the field's unit.
        base: The scene's materials by name.
        frequency: Frequency [Hz], at which ITU-R laws are taken.
        start: A value in the field's unit; "itu:concrete" or "itu:concrete@P.2040-1" for the ITU-R value;
            None for the scene's own.
        scale: "linear" or "log".

    Returns:
        The parameter.

    Raises:
        InputError: The scene has no such material, the field has no effect with the material's scattering
            pattern, or what `Parameter` and `itu_material` refuse.

    Example:
        >>> walls = {"walls": Material(5.0, 0.1, 0.3)}
        >>> make_parameter("walls.relative_permittivity", (1, 9), walls, 4e9, start="itu:brick").start
        3.91
    """
    material, field = split_name(name)
    _check_material(name, base)
    pattern = base[material].scattering_pattern
    if field in _PATTERN_FIELDS and field not in SCATTERING_PATTERNS[pattern]:
        raise InputError(
            f"parameter {name!r} has no effect: the scattering pattern of {material!r} is {pattern!r}"
        )
    if start is None:
        value = float(getattr(base[material], field))
    elif isinstance(start, str):
        value = itu_start(name, start, frequency)
    elif isinstance(start, bool) or not isfinite(start):
        raise InputError(f"{name}: start = {start!r}: must be a finite number or 'itu:NAME'")
    else:
        value = float(start)
    return Parameter(name=name, lower=float(bounds[0]), upper=float(bounds[1]), start=value, scale=scale)


def itu_start(name: str, start: str, frequency: float) -> float:
    """The value that ITU-R P.2040 gives for a start like "itu:concrete@P.2040-1".

    Args:
        name: The parameter, of the field relative_permittivity or conductivity.
        start: "itu:" and the ITU-R material, then "@" and the revision unless it is the default one.
        frequency: Frequency [Hz].

    Returns:
        The value, in the field's unit.

    Raises:
        InputError: The text has another form, the field has no ITU-R law, or what `itu_material` refuses.
    """
    field = split_name(name)[1]
    if not start.startswith(_ITU_PREFIX):
        raise InputError(
            f"{name}: start = {start!r}: must be a number or 'itu:NAME', as 'itu:concrete@P.2040-1'"
        )
    if field not in _ITU_FIELDS:
        raise InputError(f"{name}: start = {start!r}: ITU-R P.2040 gives no {field}; give a number")
    itu_name, _, revision = start.removeprefix(_ITU_PREFIX).partition("@")
    try:
        material = itu_material(itu_name, frequency, revision=revision or DEFAULT_REVISION)
    except InputError as error:
        raise InputError(f"{name}: start = {start!r}: {error}") from None
    return float(getattr(material, field))


def _check_material(name: str, materials: Mapping[str, Material] | Sequence[str]) -> None:
    material = split_name(name)[0]
    if material not in materials:
        raise InputError(
            f"parameter {name!r}: the scene has no material {material!r}; {did_you_mean(material, materials)}"
        )
