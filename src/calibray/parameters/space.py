"""Free parameters: the constants that a calibration may change, and the way from vectors to materials."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.materials import FIELDS, ItuLaw, Material, constants_matrix
from calibray.parameters.laws import LAWS, PARAMETER_BOUNDS, check_law, frequency_independent_law, power
from calibray.parameters.parameter import Parameter, check_material

_NO_LAW: Final = frequency_independent_law(Material(1.0, 0.0, 1.0))
_UNBOUNDED: Final = 1e300

MAX_PARAMETERS: Final = 10_000
"""The number of parameters beyond which a study is refused."""


@dataclass(frozen=True)
class Parameters:
    """The parameters of a study, in the order of a candidate's components.

    Attributes:
        items: The parameters, at least one.
        frequency: Carrier [Hz] at which laws are taken where none is named.
        laws: The laws of the materials of which some coefficient is a parameter, by material; a coefficient that is no
            parameter keeps its value there. Absent, it is that of a material with the same constants everywhere.

    Raises:
        InputError: There is none, a name stands twice, or a constant and a coefficient of its law are both parameters.

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
            raise InputError('parameters: none given; name at least one, as "walls.relative_permittivity"')
        if len(self.items) > MAX_PARAMETERS:
            raise InputError(
                f"parameters: {len(self.items)}, must be at most {MAX_PARAMETERS}; let objects share a material"
            )
        counts = Counter(self.names)
        if twice := [name for name, count in counts.items() if count > 1]:
            raise InputError(f"parameters: {twice[0]!r} stands twice; remove one")
        for parameter in self.items:
            constant = f"{parameter.material}.{parameter.constant}"
            if parameter.name != constant and constant in counts:
                raise InputError(
                    f"parameters: {constant!r} is the same at every carrier and {parameter.name!r} belongs to its law; "
                    "remove one"
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

    def named(self, candidate: ArrayLike) -> dict[str, float]:
        """The values of a candidate [parameters] by the parameters' names.

        Raises:
            InputError: The candidate has another length.
        """
        return dict(zip(self.names, self._components(candidate).tolist(), strict=True))

    def constants_and_slopes(
        self, candidates: ArrayLike, frequency: float | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What candidates put into a constants matrix at one carrier.

        Args:
            candidates: Parameter values [..., parameters], in the fields' units.
            frequency: The carrier [Hz]; `frequency` of the parameters if None.

        Returns:
            The value of the constant that each parameter acts on [..., parameters], in its unit, and its derivative
            by the parameter [..., parameters]. Two coefficients of one law have one value and a derivative each.

        Raises:
            InputError: The candidates have another length.
        """
        given = self._components(candidates)
        values, slopes = given.copy(), np.ones_like(given)
        for _, scale, exponent, fixed in self._laws():
            found = power(
                np.asarray(fixed[0]) if scale is None else given[..., scale],
                np.asarray(fixed[1]) if exponent is None else given[..., exponent],
                self.frequency if frequency is None else frequency,
            )
            for place, slope in ((scale, found.by_scale), (exponent, found.by_exponent)):
                if place is not None:
                    values[..., place], slopes[..., place] = found.value, slope
        return values, slopes

    @property
    def has_laws(self) -> bool:
        """Whether some parameter is a coefficient of a law."""
        return any(parameter.field != parameter.constant for parameter in self.items)

    def at_carrier(self, frequency: float) -> tuple[Parameters, NDArray[np.int64]]:
        """The constants that the parameters act on, as parameters themselves: what is left of laws at one carrier.

        Args:
            frequency: The carrier [Hz].

        Returns:
            A parameter for each constant, bounded by physics alone where it follows a law, and the place of each of
            these parameters' constants among them [parameters].
        """
        if not self.has_laws:
            return self, np.arange(len(self))
        starts, _ = self.constants_and_slopes(self.start, frequency)
        found: dict[str, Parameter] = {}
        for parameter, start in zip(self.items, starts.tolist(), strict=True):
            name = f"{parameter.material}.{parameter.constant}"
            least = PARAMETER_BOUNDS[parameter.constant].lower
            lawful = Parameter(name, least, _UNBOUNDED, start) if name != parameter.name else parameter
            found.setdefault(name, lawful)
        order = {name: place for place, name in enumerate(found)}
        places = [order[f"{parameter.material}.{parameter.constant}"] for parameter in self.items]
        return Parameters(tuple(found.values()), frequency), np.array(places, dtype=np.int64)

    def law_coefficients(self, candidate: ArrayLike) -> dict[str, dict[str, float]]:
        """The coefficients of the laws that a candidate describes.

        Args:
            candidate: Parameter values [parameters], in the fields' units.

        Returns:
            By material with a coefficient among the parameters: the law of each constant that has one there.
        """
        values = self._components(candidate)
        found: dict[str, dict[str, float]] = {}
        for parameter, scale, exponent, fixed in self._laws():
            for name, place, value in zip(LAWS[parameter.constant], (scale, exponent), fixed, strict=True):
                found.setdefault(parameter.material, {})[name] = float(
                    value if place is None else values[place]
                )
        return found

    def check_carriers(self, frequencies: Sequence[float]) -> None:
        """Refuse bounds of laws between which a constant leaves physics at some carrier.

        Args:
            frequencies: The carriers [Hz].

        Raises:
            InputError: A law lies outside its constant's bound; the message names the carrier.
        """
        for parameter, scale, exponent, fixed in self._laws():
            bounds = [
                (fixed[k],) if place is None else (self.items[place].lower, self.items[place].upper)
                for k, place in enumerate((scale, exponent))
            ]
            check_law(parameter.material, parameter.constant, bounds[0], bounds[1], frequencies)

    def _laws(self) -> Iterator[tuple[Parameter, int | None, int | None, tuple[float, float]]]:
        """Every law, by its first parameter.

        Yields:
            The parameter, the places of the coefficient and the exponent, None where fixed, and what they are fixed at.
        """
        done, order = set(), {name: place for place, name in enumerate(self.names)}
        for parameter in self.items:
            constant = parameter.constant
            if parameter.field == constant or (parameter.material, constant) in done:
                continue
            done.add((parameter.material, constant))
            names = LAWS[constant]
            scale, exponent = (order.get(f"{parameter.material}.{name}") for name in names)
            law = self.laws.get(parameter.material, _NO_LAW)
            fixed_scale, fixed_exponent = (getattr(law, name[-1]) for name in names)
            yield parameter, scale, exponent, (fixed_scale, fixed_exponent)

    def materials(
        self, candidate: ArrayLike, base: Mapping[str, Material], frequency: float | None = None
    ) -> dict[str, Material]:
        """The materials that a candidate describes, at one carrier.

        Args:
            candidate: Parameter values [parameters], in the fields' units.
            base: The scene's materials by name; what is no parameter stays as it is.
            frequency: The carrier [Hz]; `frequency` of the parameters if None.

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
        entries, _ = self.constants_and_slopes(values, frequency)
        for parameter, value in zip(self.items, entries.tolist(), strict=True):
            check_material(parameter.name, base)
            changes.setdefault(parameter.material, {})[parameter.constant] = value
        return {name: replace(material, **changes.get(name, {})) for name, material in base.items()}

    def matrix_indices(self, materials: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where each parameter stands in a constants matrix [materials, fields].

        A pure replay scatters candidates with them: ``constants.at[..., rows, columns].set(candidates)``. Coefficients
        of laws stand nowhere there; what they come to at a carrier does (`at_carrier`).

        Args:
            materials: The names of the matrix's rows, in order; its columns are `FIELDS`.

        Returns:
            The rows [parameters] and the columns [parameters].

        Raises:
            InputError: A parameter's material is not among them, or a parameter is a coefficient of a law.
        """
        if self.has_laws:
            raise InputError(
                f"parameters {', '.join(self.names)}: a law stands in no constants matrix; take them at a carrier"
            )
        order = {name: row for row, name in enumerate(materials)}
        for name in self.names:
            check_material(name, order)
        rows = np.array([order[parameter.material] for parameter in self.items], dtype=np.int64)
        columns = np.array([FIELDS.index(parameter.field) for parameter in self.items], dtype=np.int64)
        return rows, columns

    def constants_of(
        self, candidates: ArrayLike, base: Mapping[str, Material], frequency: float | None = None
    ) -> NDArray[np.float64]:
        """The constants of the materials that candidates describe, at one carrier.

        Args:
            candidates: Parameter values [..., parameters], in the fields' units.
            base: The scene's materials by name, in the order of the rows.
            frequency: The carrier [Hz]; `frequency` of the parameters if None.

        Returns:
            The constants [..., materials, fields], columns as `FIELDS`.

        Raises:
            InputError: The candidates have another length, or a parameter's material is unknown.
        """
        carrier = self.frequency if frequency is None else frequency
        (values, _), (acting, places) = (
            self.constants_and_slopes(candidates, carrier),
            self.at_carrier(carrier),
        )
        rows, columns = (index[places] for index in acting.matrix_indices(list(base)))
        matrix = constants_matrix(base)
        batch = np.broadcast_to(matrix, (*values.shape[:-1], *matrix.shape)).copy()
        batch[..., rows, columns] = values
        return batch

    @property
    def search_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The lower and the upper bounds [parameters] of the search space."""
        return self.to_search(self.lower), self.to_search(self.upper)

    def to_search(self, candidates: ArrayLike) -> NDArray[np.float64]:
        """Candidates [..., parameters] as optimizers see them: some as logarithms, where the search is to span decades.

        Others keep their physical unit, as in the paper.

        Raises:
            InputError: The candidates have another length.
        """
        values = self._components(candidates)
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, values, 1.0)), values)

    def from_search(self, points: ArrayLike) -> NDArray[np.float64]:
        """Candidates [..., parameters] in the fields' units from points of the search space; never beyond the bounds.

        Raises:
            InputError: The points have another length.
        """
        values = self._components(points)
        values = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, values, 0.0)), values)
        # Rounding of exp and log would otherwise leave the bounds by an ulp.
        return np.clip(values, self.lower, self.upper)

    def search_slope(self, candidates: ArrayLike) -> NDArray[np.float64]:
        """Derivatives [..., parameters] of the fields' units by the search coordinates, at candidates.

        Raises:
            InputError: The candidates have another length.
        """
        return np.where(self.logarithmic, self._components(candidates), 1.0)

    def to_unit(self, candidates: ArrayLike) -> NDArray[np.float64]:
        """Candidates [..., parameters] of the search space, scaled so that the bounds become 0 and 1.

        Raises:
            InputError: The candidates have another length.
        """
        lower, upper = self.search_bounds
        return (self.to_search(candidates) - lower) / (upper - lower)

    def from_unit(self, unit: ArrayLike) -> NDArray[np.float64]:
        """Candidates [..., parameters] from values in which the bounds are 0 and 1; never beyond the bounds.

        Raises:
            InputError: The values have another length.
        """
        lower, upper = self.search_bounds
        return self.from_search(lower + self._components(unit) * (upper - lower))

    def _components(self, values: ArrayLike) -> NDArray[np.float64]:
        array = np.asarray(values, dtype=np.float64)
        if array.ndim == 0 or array.shape[-1] != len(self):
            raise InputError(
                f"candidates: shape {array.shape}, must end in {len(self)}, one value per parameter"
            )
        return array
