"""The search space of a calibration, and the materials that the points of this space describe."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.materials import FIELDS, ItuLaw, Material, constants_matrix, frequency_independent_law
from calibray.parameters.parameter import (
    LAWS,
    PARAMETER_BOUNDS,
    Parameter,
    check_law,
    check_material,
    power_law,
)

_DEFAULT_LAW: Final = frequency_independent_law(Material(1.0, 0.0, 1.0))
_UNBOUNDED: Final = 1e300

MAX_PARAMETERS: Final = 10_000
"""Maximum number of parameters of a study."""


class _Law(NamedTuple):
    """A law s f^e in which s, e or both are parameters."""

    material: str
    constant: str
    scale: int | None  # index of the parameter that is s; None if s is fixed
    exponent: int | None  # index of the parameter that is e; None if e is fixed
    fixed_scale: float
    fixed_exponent: float


@dataclass(frozen=True)
class Parameters:
    """The parameters of a study, in the order of the values of a candidate.

    Attributes:
        items: The parameters, at least one.
        frequency: Carrier frequency [Hz] at which laws are evaluated by default.
        laws: Laws by material, for materials with a calibrated coefficient. The other coefficients are fixed at the
            values of these laws. By default, the constants do not depend on frequency.

    Raises:
        InputError: There are no parameters, a name is repeated, or a constant and a coefficient of its law are both
            parameters.

    Example:
        >>> wall = Parameter("walls.relative_permittivity", lower=1.0, upper=11.0, start=5.0)
        >>> parameters = Parameters((wall,))
        >>> parameters.materials([7.0], {"walls": Material(5.0, 0.1, 0.3)})["walls"].relative_permittivity
        7.0
        >>> parameters.to_unit([[6.0]]).tolist()
        [[0.5]]
    """

    items: tuple[Parameter, ...]
    frequency: float = 1e9
    laws: Mapping[str, ItuLaw] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "items", tuple(self.items))
        if not self.items:
            raise InputError(
                'parameters: none given; give at least one parameter, such as "walls.relative_permittivity"'
            )
        if len(self.items) > MAX_PARAMETERS:
            raise InputError(
                f"parameters: {len(self.items)}, must be at most {MAX_PARAMETERS}; assign one material to several "
                "objects"
            )
        counts = Counter(self.names)
        if repeated := [name for name, count in counts.items() if count > 1]:
            raise InputError(f"parameters: {repeated[0]!r} is given twice; remove one entry")
        for parameter in self.items:
            constant = _constant_name(parameter)
            if parameter.name != constant and constant in counts:
                raise InputError(
                    f"parameters: {constant!r} is independent of frequency, but {parameter.name!r} is a coefficient of "
                    "its law; remove one of the two"
                )

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
        """The lower bounds [parameters], in the units of the fields."""
        return np.array([parameter.lower for parameter in self.items], dtype=np.float64)

    @property
    def upper(self) -> NDArray[np.float64]:
        """The upper bounds [parameters], in the units of the fields."""
        return np.array([parameter.upper for parameter in self.items], dtype=np.float64)

    @property
    def start(self) -> NDArray[np.float64]:
        """The start values [parameters], in the units of the fields."""
        return np.array([parameter.start for parameter in self.items], dtype=np.float64)

    @property
    def logarithmic(self) -> NDArray[np.bool_]:
        """Whether each parameter [parameters] is searched on a logarithmic scale."""
        return np.array([parameter.scale == "log" for parameter in self.items])

    def named(self, candidate: ArrayLike) -> dict[str, float]:
        """The values of a candidate [parameters], keyed by parameter name."""
        return dict(zip(self.names, self._components(candidate).tolist(), strict=True))

    @cached_property
    def of_effects(self) -> NDArray[np.int64]:
        """Indices of the parameters that belong to effects instead of materials."""
        return np.array([k for k, item in enumerate(self.items) if item.is_effect], dtype=np.int64)

    @cached_property
    def of_materials(self) -> NDArray[np.int64]:
        """Indices of the parameters that belong to materials."""
        return np.array([k for k, item in enumerate(self.items) if not item.is_effect], dtype=np.int64)

    # Constants of materials

    @property
    def has_laws(self) -> bool:
        """Whether a parameter is a coefficient of a law."""
        return any(parameter.field != parameter.constant for parameter in self.items)

    def constants_and_slopes(
        self, candidates: ArrayLike, frequency: float | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Constants [..., parameters] that candidates determine at one carrier, and derivatives of these constants.

        The derivatives have the same shape as the constants. If `frequency` is None, the carrier is that of the
        parameters. Both coefficients of a law yield the constant that they determine together.

        Raises:
            InputError: The candidates have the wrong length.
        """
        given = self._components(candidates)
        constants, slopes = given.copy(), np.ones_like(given)
        for law in self._laws():
            values = power_law(
                np.asarray(law.fixed_scale) if law.scale is None else given[..., law.scale],
                np.asarray(law.fixed_exponent) if law.exponent is None else given[..., law.exponent],
                self.frequency if frequency is None else frequency,
            )
            if law.scale is not None:
                constants[..., law.scale], slopes[..., law.scale] = values.value, values.by_scale
            if law.exponent is not None:
                constants[..., law.exponent], slopes[..., law.exponent] = values.value, values.by_exponent
        return constants, slopes

    def at_carrier(self, frequency: float) -> tuple[Parameters, NDArray[np.int64]]:
        """The constants that the parameters determine at one carrier [Hz], as parameters.

        A constant that follows a law has only its physical bounds. The second result [parameters] is the index of the
        constant that each original parameter determines.
        """
        if not self.has_laws:
            return self, np.arange(len(self))
        starts, _ = self.constants_and_slopes(self.start, frequency)
        constants: dict[str, Parameter] = {}
        for parameter, start in zip(self.items, starts.tolist(), strict=True):
            name = _constant_name(parameter)
            if name != parameter.name:
                # The bounds of a coefficient are not bounds of the constant.
                parameter = Parameter(name, PARAMETER_BOUNDS[parameter.constant].lower, _UNBOUNDED, start)
            constants.setdefault(name, parameter)
        number = {name: index for index, name in enumerate(constants)}
        indices = [number[_constant_name(parameter)] for parameter in self.items]
        return Parameters(tuple(constants.values()), frequency), np.array(indices, dtype=np.int64)

    def law_coefficients(self, candidate: ArrayLike) -> dict[str, dict[str, float]]:
        """Both coefficients of every law that has a coefficient among the parameters, by material.

        Raises:
            InputError: The candidate has the wrong length.
        """
        values = self._components(candidate)
        coefficients: dict[str, dict[str, float]] = {}
        for law in self._laws():
            scale_name, exponent_name = LAWS[law.constant]
            of_material = coefficients.setdefault(law.material, {})
            of_material[scale_name] = float(law.fixed_scale if law.scale is None else values[law.scale])
            of_material[exponent_name] = float(
                law.fixed_exponent if law.exponent is None else values[law.exponent]
            )
        return coefficients

    def check_carriers(self, frequencies: Sequence[float]) -> None:
        """Raise an error if bounds of laws allow an impossible constant at any of the carriers [Hz].

        Raises:
            InputError: A law exceeds the physical bounds of its constant. The message names the carrier.
        """
        for law in self._laws():
            scales = (law.fixed_scale,) if law.scale is None else self._bounds(law.scale)
            exponents = (law.fixed_exponent,) if law.exponent is None else self._bounds(law.exponent)
            check_law(law.material, law.constant, scales, exponents, frequencies)

    def _bounds(self, index: int) -> tuple[float, float]:
        return self.items[index].lower, self.items[index].upper

    def _laws(self) -> Iterator[_Law]:
        """Yield every law once."""
        seen: set[tuple[str, str]] = set()
        number = {name: index for index, name in enumerate(self.names)}
        for parameter in self.items:
            material, constant = parameter.material, parameter.constant
            if parameter.field == constant or (material, constant) in seen:
                continue
            seen.add((material, constant))
            scale, exponent = LAWS[constant]
            law = self.laws.get(material, _DEFAULT_LAW)
            yield _Law(
                material,
                constant,
                scale=number.get(f"{material}.{scale}"),
                exponent=number.get(f"{material}.{exponent}"),
                fixed_scale=getattr(law, scale.removeprefix("itu_")),
                fixed_exponent=getattr(law, exponent.removeprefix("itu_")),
            )

    def materials(
        self, candidate: ArrayLike, base: Mapping[str, Material], frequency: float | None = None
    ) -> dict[str, Material]:
        """All materials of `base`, in the same order, with the values of a candidate [parameters] at one carrier.

        If `frequency` is None, the carrier is that of the parameters.

        Raises:
            InputError: The candidate has the wrong length, a value is physically impossible, or a material is unknown.
        """
        values = np.asarray(candidate, dtype=np.float64)
        if values.shape != (len(self),):
            raise InputError(
                f"candidate: shape {values.shape}, must be ({len(self)},), one value per parameter"
            )
        changes: dict[str, dict[str, float]] = {}
        constants, _ = self.constants_and_slopes(values, frequency)
        for parameter, value in zip(self.items, constants.tolist(), strict=True):
            if parameter.is_effect:
                continue
            check_material(parameter.name, base)
            changes.setdefault(parameter.material, {})[parameter.constant] = value
        return {name: replace(material, **changes.get(name, {})) for name, material in base.items()}

    def matrix_indices(self, materials: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row and column of each material parameter in a matrix [materials, fields] of constants.

        Replay uses these indices to insert candidates: ``constants.at[..., rows, columns].set(candidates)``.
        Coefficients of frequency laws have no entry; use the parameters of `at_carrier` instead.

        Raises:
            InputError: The material of a parameter is not in `materials`, or a parameter is a coefficient of a law.
        """
        if self.has_laws:
            raise InputError(
                f"parameters {', '.join(self.names)}: coefficients of frequency laws have no entry in a matrix of "
                "constants; call at_carrier first"
            )
        row_of = {name: row for row, name in enumerate(materials)}
        items = [parameter for parameter in self.items if not parameter.is_effect]
        for parameter in items:
            check_material(parameter.name, row_of)
        rows = np.array([row_of[parameter.material] for parameter in items], dtype=np.int64)
        columns = np.array([FIELDS.index(parameter.field) for parameter in items], dtype=np.int64)
        return rows, columns

    def constants_of(
        self, candidates: ArrayLike, base: Mapping[str, Material], frequency: float | None = None
    ) -> NDArray[np.float64]:
        """The constants [..., materials, fields] of candidates [..., parameters] at one carrier.

        Rows are in the order of `base`, and columns in the order of `FIELDS`. If `frequency` is None, the carrier is
        that of the parameters.

        Raises:
            InputError: The candidates have the wrong length, or the material of a parameter is unknown.
        """
        carrier = self.frequency if frequency is None else frequency
        values, _ = self.constants_and_slopes(candidates, carrier)
        parameters, indices = self.at_carrier(carrier)
        rows, columns = parameters.matrix_indices(list(base))
        matrix = constants_matrix(base)
        batch = np.broadcast_to(matrix, (*values.shape[:-1], *matrix.shape)).copy()
        # Effects have no entries in `rows` and `columns`.
        cell = np.searchsorted(parameters.of_materials, indices[self.of_materials])
        batch[..., rows[cell], columns[cell]] = values[..., self.of_materials]
        return batch

    # Search coordinates are logarithms for parameters that span decades, and otherwise values in the physical unit, as
    # in the paper. In unit coordinates, the bounds become 0 and 1.

    @property
    def search_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The lower and upper bounds [parameters] of the search space."""
        at_lower = np.array([parameter.at_lower for parameter in self.items], dtype=np.float64)
        return self.to_search(self.lower) - at_lower, self.to_search(self.upper)

    def to_search(self, candidates: ArrayLike) -> NDArray[np.float64]:
        """Convert candidates [..., parameters] to points of the search space."""
        values = self._components(candidates)
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, values, 1.0)), values)

    def from_search(self, points: ArrayLike) -> NDArray[np.float64]:
        """Convert points of the search space [..., parameters] to candidates within the bounds."""
        values = self._components(points)
        values = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, values, 0.0)), values)
        # Without clipping, rounding errors of exp and log could exceed the bounds by one unit in the last place.
        return np.clip(values, self.lower, self.upper)

    def search_slope(self, candidates: ArrayLike) -> NDArray[np.float64]:
        """Derivatives of parameter values with respect to search coordinates, at candidates [..., parameters]."""
        # The derivative of exp(u) is exp(u), the value itself.
        return np.where(self.logarithmic, self._components(candidates), 1.0)

    def to_unit(self, candidates: ArrayLike) -> NDArray[np.float64]:
        """Convert candidates [..., parameters] to unit coordinates."""
        lower, upper = self.search_bounds
        return (self.to_search(candidates) - lower) / (upper - lower)

    def from_unit(self, unit: ArrayLike) -> NDArray[np.float64]:
        """Convert unit coordinates [..., parameters] to candidates within the bounds."""
        lower, upper = self.search_bounds
        return self.from_search(lower + self._components(unit) * (upper - lower))

    def _components(self, values: ArrayLike) -> NDArray[np.float64]:
        array = np.asarray(values, dtype=np.float64)
        if array.ndim == 0 or array.shape[-1] != len(self):
            raise InputError(
                f"candidates: shape {array.shape}, must end in {len(self)}, one value per parameter"
            )
        return array


def _constant_name(parameter: Parameter) -> str:
    return f"{parameter.material}.{parameter.constant}"
