"""What shifts path loss beside the materials: columns of a linear design, each times an unknown coefficient.

An offset for all links or for each group, a slope per decade of distance, any numeric column of the links. A term
is one such column, split up by groups if asked for; several terms make one design [links, q]. It is kept sparse: a
link has one entry for each term, however many groups there are.

Being linear, the best coefficients are known in closed form for every candidate (variable projection), within their
bounds and with Gaussian priors; `elimination.py` has that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from calibray.errors import InputError
from calibray.measurements import Measurements

CONSTANT: Final = "constant"
LOG_DISTANCE: Final = "log_distance"

OFFSET: Final = "offset"
"""Name of the term that `[offset]` makes."""

UNKNOWN_DB: Final = 10.0
"""Spread of groups of which only one is known [dB per unit of the column]."""

UNBOUNDED: Final = (-np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class Term:
    """One column of the links times an unknown coefficient, or one coefficient for each group of links.

    Attributes:
        name: Its name.
        by: What the column is: "constant", "log_distance", or a column of the links' table.
        value: The column [L]: 1 for a constant; decades of distance from `centre`; else the column's own unit.
        group: Group of every link [L]; -1 where a link belongs to none of `labels`.
        labels: Labels of the groups; one nameless group for all links.
        bounds: Lower and upper bound of every coefficient, [dB] per unit of the column.
        prior: Standard deviation of the coefficients' Gaussian prior around zero, in the same unit; +inf for none.
        centre: What was taken off the column: the mean of log10(distance / 1 m) of the links first seen, else 0.
    """

    name: str
    by: str
    value: NDArray[np.float64]
    group: NDArray[np.int64]
    labels: tuple[str, ...] = ("",)
    bounds: tuple[float, float] = UNBOUNDED
    prior: float = np.inf
    centre: float = 0.0

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of its columns: the term's own, with the group in brackets if there are groups."""
        return tuple(f"{self.name}[{label}]" if label else self.name for label in self.labels)

    def at(self, links: Measurements, labels: ArrayLike | None = None) -> Term:
        """The same term at other links, for prediction.

        Args:
            links: The links.
            labels: Their groups' labels [n]; one never seen belongs to no group. None for a term without groups.

        Returns:
            The term, its columns those of this one.

        Raises:
            InputError: The links' table lacks the column, or the labels do not fit.
        """
        if (labels is None) != (self.labels == ("",)):
            need = "takes no labels" if labels is not None else "needs the labels of the links' groups"
            raise InputError(f"nuisance {self.name!r}: {need}")
        value = _column(links, self.by) - self.centre
        if labels is None:
            return replace(self, value=value, group=np.zeros(len(links), dtype=np.int64))
        given = _labels(self.name, links, labels)
        place = np.minimum(np.searchsorted(self.labels, given), len(self.labels) - 1)
        return replace(self, value=value, group=np.where(np.array(self.labels)[place] == given, place, -1))


def make_term(
    links: Measurements,
    name: str,
    by: str = CONSTANT,
    *,
    labels: ArrayLike | None = None,
    bounds: tuple[float, float] | None = None,
    prior: float | None = None,
) -> Term:
    """A term of a nuisance.

    Args:
        links: The links.
        name: Name of the term.
        by: "constant" for an offset [dB]; "log_distance" for a slope [dB per decade], which turns about the links'
            geometric mean distance; or a numeric column of the links' table.
        labels: Labels of the links' groups [L], for one coefficient each; one coefficient for all links if None.
        bounds: Lower and upper bound of the coefficients; unbounded if None.
        prior: Standard deviation of the coefficients' Gaussian prior around zero; flat if None.

    Returns:
        The term.

    Raises:
        InputError: The bounds are not ordered, the prior is not positive, the labels do not fit, or the column does
            not exist or is not numeric.

    Example:
        >>> links = Measurements(tx=[[0, 0, 10]] * 2, rx=[[30, 40, 10], [300, 400, 10]], path_loss_db=[85, 110])
        >>> make_term(links, "offset", labels=["a", "b"], bounds=(-10, 10)).columns
        ('offset[a]', 'offset[b]')
        >>> make_term(links, "clutter", "log_distance").value.tolist()
        [-0.5, 0.5]
    """
    place = f"nuisance {name!r}"
    lower, upper = UNBOUNDED if bounds is None else bounds
    if not lower < upper:
        raise InputError(f"{place}: bounds = [{lower:g}, {upper:g}]; the lower must be less than the upper")
    if prior is not None and not prior > 0:
        raise InputError(f"{place}: prior = {prior:g}; a standard deviation must be greater than 0")
    value = _column(links, by)
    centre = float(value.mean()) if by == LOG_DISTANCE else 0.0
    if labels is None:
        known, group = ("",), np.zeros(len(links), dtype=np.int64)
    else:
        names, group = np.unique(_labels(name, links, labels), return_inverse=True)
        known = tuple(map(str, names))
    prior = np.inf if prior is None else float(prior)
    return Term(name, by, value - centre, group, known, (float(lower), float(upper)), prior, centre)


def transmitters(links: Measurements) -> NDArray[np.str_]:
    """Labels of the links' transmitters, by where they stand to the centimetre.

    Args:
        links: The links.

    Returns:
        A label for each link [L].
    """
    return np.array([",".join(f"{each:.2f}" for each in place) for place in links.tx], dtype=np.str_)


def _column(links: Measurements, by: str) -> NDArray[np.float64]:
    if by == CONSTANT:
        return np.ones(len(links))
    return np.log10(links.distance) if by == LOG_DISTANCE else links.table.numbers(by)


def _labels(name: str, links: Measurements, labels: ArrayLike) -> NDArray[np.str_]:
    given = np.asarray(labels, dtype=np.str_)
    if given.shape != (len(links),):
        raise InputError(
            f"nuisance {name!r}: labels of shape {given.shape}, must be ({len(links)},), one per link"
        )
    return given


@dataclass(frozen=True, eq=False)
class Nuisance:
    """A linear design [links, q].

    Attributes:
        num_links: Number of links L.
        terms: Its terms; none for a design without columns.

    Raises:
        InputError: A term is of other links, or two have the same name.
    """

    num_links: int
    terms: tuple[Term, ...] = ()

    def __post_init__(self) -> None:
        names = [term.name for term in self.terms]
        for term in self.terms:
            if len(term.value) != self.num_links:
                raise InputError(
                    f"nuisance {term.name!r}: {len(term.value)} links, must be {self.num_links} as for the others"
                )
            if names.count(term.name) > 1:
                raise InputError(f"nuisance {term.name!r}: two terms have this name; rename one")

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns [q], term after term."""
        return tuple(name for term in self.terms for name in term.columns)

    @cached_property
    def lower(self) -> NDArray[np.float64]:
        """Lower bounds [q], [dB] per unit of the column."""
        return self._each([term.bounds[0] for term in self.terms])

    @cached_property
    def upper(self) -> NDArray[np.float64]:
        """Upper bounds [q], [dB] per unit of the column."""
        return self._each([term.bounds[1] for term in self.terms])

    @cached_property
    def prior(self) -> NDArray[np.float64]:
        """Standard deviations of the priors [q], [dB] per unit of the column; +inf where flat."""
        return self._each([term.prior for term in self.terms])

    @cached_property
    def design(self) -> sparse.csr_array:
        """The design [L, q]: one entry in a row for each term that the link belongs to a group of."""
        parts = [sparse.csr_array((self.num_links, 0))]
        for term in self.terms:
            row = np.flatnonzero(term.group >= 0)
            entries = (term.value[row], (row, term.group[row]))
            parts.append(sparse.csr_array(entries, shape=(self.num_links, len(term.labels))))
        return sparse.csr_array(sparse.hstack(parts))

    @cached_property
    def layout(self) -> tuple[NDArray[np.int64], int, int]:
        """How the normal equations come apart.

        Returns:
            Order of the columns [q] in which those of the finest grouping come first, group after group; the number
            of its groups; and the number of its terms. Columns of different groups share no link.
        """
        first = np.cumsum([0, *(len(term.labels) for term in self.terms)])
        alike: dict[bytes, list[int]] = {}
        for index, term in enumerate(self.terms):
            alike.setdefault(term.group.tobytes(), []).append(index)
        finest = max(alike.values(), key=lambda terms: (len(self.terms[terms[0]].labels), len(terms)))
        groups = len(self.terms[finest[0]].labels)
        inner = (first[finest][None] + np.arange(groups)[:, None]).ravel()
        order = np.concatenate([inner, np.setdiff1d(np.arange(first[-1]), inner)])
        return order.astype(np.int64), groups, len(finest)

    def contribution(self, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the nuisance adds to path loss.

        Args:
            coefficients: Coefficients [n, q].

        Returns:
            The sum of its columns times the coefficients [n, L], [dB].
        """
        return (self.design @ coefficients.T).T

    def filled(
        self, coefficients: NDArray[np.float64], counted: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coefficients with those of groups never seen filled in: the mean of the others of their term.

        Args:
            coefficients: Coefficients fitted to some links [n, q].
            counted: Which links these are [L].

        Returns:
            All coefficients [n, q], and the standard deviation of each: the spread of the groups where none of a
            group's links was seen, else 0 [q].
        """
        seen = np.asarray(abs(self.design[counted]).sum(axis=0)).ravel() > 0
        found, spread, first = coefficients.copy(), np.zeros(len(seen)), 0
        for term in self.terms:
            here = np.arange(first, first := first + len(term.labels))
            known, unknown = here[seen[here]], here[~seen[here]]
            if len(known) and len(unknown):
                found[:, unknown] = coefficients[:, known].mean(axis=1, keepdims=True)
                # A further one lies around a mean that is uncertain itself.
                size = np.std(coefficients[0, known], ddof=1) if len(known) > 1 else UNKNOWN_DB
                spread[unknown] = size * np.sqrt(1 + 1 / len(known))
        return found, spread

    def _each(self, values: list[float]) -> NDArray[np.float64]:
        return np.repeat(np.array(values, dtype=np.float64), [len(term.labels) for term in self.terms])
