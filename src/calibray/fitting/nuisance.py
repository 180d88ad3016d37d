"""Nuisances: linear terms with unknown coefficients, added to the modelled path loss.

A term has one value per link: a constant (for an offset), the logarithm of the distance (for a slope per decade), or
any numeric column of the table. A term has one coefficient for all links, or one coefficient per group. Several terms
form one design [links, q]. The design is sparse: a link has one entry per term, regardless of the number of groups.

The model is linear in the coefficients. For every candidate, the best coefficients within their bounds and with
Gaussian priors follow in closed form (variable projection); see `elimination.py`.
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
from calibray.study.calibration_sections import OFFSET
from calibray.study.model import StudyModel

CONSTANT: Final = "constant"
LOG_DISTANCE: Final = "log_distance"

UNKNOWN_DB: Final = 10.0
"""Assumed standard deviation between groups if only one group is measured [dB per unit of the column]. This value is
large because a single group contains no information about the spread."""

START_SPREAD: Final = 6.0
"""Standard deviation [dB per unit of the column] between the groups of a random effect before it is estimated."""

ROUNDING: Final = 1e-9
"""Maximum difference [decades] between distances that is attributed to rounding."""

UNBOUNDED: Final = (-np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class Term:
    """A column of values, one per link, with one unknown coefficient for all links or one per group of links.

    Attributes:
        name: Name of the term.
        by: The column: "constant", "log_distance", or a column of the links' table.
        value: The values of the column [L]: 1 for a constant; decades of distance relative to `centre` for
            "log_distance"; otherwise in the unit of the table.
        group: Index [L] of each link's group in `labels`; -1 for a link in none of these groups.
        labels: Labels of the groups; one empty label if all links share one coefficient.
        bounds: Lower and upper bound of every coefficient, [dB] per unit of the column.
        prior: Standard deviation of the coefficients' Gaussian prior around zero, in the unit of the bounds; +inf for a
            flat prior.
        centre: Value subtracted from the column: for "log_distance", the mean of log10(distance / 1 m) over the links
            for which the term was made; otherwise 0.
        around: For the deviations of a random effect, the name of the term that contains the mean; otherwise "".
    """

    name: str
    by: str
    value: NDArray[np.float64]
    group: NDArray[np.int64]
    labels: tuple[str, ...] = ("",)
    bounds: tuple[float, float] = UNBOUNDED
    prior: float = np.inf
    centre: float = 0.0
    around: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the term's columns: the name of the term, followed by the group in brackets if there are groups."""
        return tuple(f"{self.name}[{label}]" if label else self.name for label in self.labels)

    def at(self, links: Measurements, labels: ArrayLike | None = None) -> Term:
        """The same term evaluated at other links, for prediction.

        `labels` [n] are the labels of the links' groups; a link with an unknown label belongs to no group. Pass no
        labels for a term without groups.

        Raises:
            InputError: The links' table lacks the column, or the labels do not match the term.
        """
        if (labels is None) != (self.labels == ("",)):
            need = "takes no labels" if labels is not None else "needs the labels of the links' groups"
            raise InputError(f"nuisance {self.name!r}: {need}")
        value = column(links, self.by) - self.centre
        if labels is None:
            return replace(self, value=value, group=np.zeros(len(links), dtype=np.int64))
        link_labels = _labels(self.name, links, labels)
        # The labels are sorted, so the index found for an unknown label is that of a neighbouring label, which differs
        # from it.
        index = np.minimum(np.searchsorted(self.labels, link_labels), len(self.labels) - 1)
        matches = np.array(self.labels)[index] == link_labels
        return replace(self, value=value, group=np.where(matches, index, -1))


def make_term(
    links: Measurements,
    name: str,
    by: str = CONSTANT,
    *,
    labels: ArrayLike | None = None,
    bounds: tuple[float, float] | None = None,
    prior: float | None = None,
) -> Term:
    """Make a term of a nuisance.

    Args:
        links: The links.
        name: Name of the term.
        by: "constant" for an offset [dB]; "log_distance" for a slope [dB per decade], centred at the links' geometric
            mean distance; or a numeric column of the links' table.
        labels: Labels [L] of the links' groups, each of which gets a coefficient; if None, all links share one
            coefficient.
        bounds: Lower and upper bound of the coefficients; unbounded if None.
        prior: Standard deviation of the coefficients' Gaussian prior around zero; flat if None.

    Raises:
        InputError: The bounds are not ordered, the prior is not positive, the number of labels is wrong, or the column
            does not exist or is not numeric.

    Example:
        >>> links = Measurements(tx=[[0, 0, 10]] * 2, rx=[[30, 40, 10], [300, 400, 10]], path_loss_db=[85, 110])
        >>> make_term(links, "offset", labels=["a", "b"], bounds=(-10, 10)).columns
        ('offset[a]', 'offset[b]')
        >>> make_term(links, "clutter", "log_distance").value.tolist()
        [-0.5, 0.5]
    """
    lower, upper = UNBOUNDED if bounds is None else bounds
    if not lower < upper:
        raise InputError(
            f"nuisance {name!r}: bounds = [{lower:g}, {upper:g}]; the lower bound must be less than the upper bound"
        )
    if prior is not None and not prior > 0:
        raise InputError(f"nuisance {name!r}: prior = {prior:g}; a standard deviation must be greater than 0")
    value = column(links, by)
    centre = float(value.mean()) if by == LOG_DISTANCE else 0.0
    if by == LOG_DISTANCE and np.allclose(value, centre, rtol=0.0, atol=ROUNDING):
        value = np.full(len(links), centre)  # equal distances determine no slope
    if labels is None:
        groups, group = ("",), np.zeros(len(links), dtype=np.int64)
    else:
        distinct, group = np.unique(_labels(name, links, labels), return_inverse=True)
        groups = tuple(map(str, distinct))
    prior = np.inf if prior is None else float(prior)
    return Term(name, by, value - centre, group, groups, (float(lower), float(upper)), prior, centre)


def random_effect(links: Measurements, name: str, by: str, labels: ArrayLike) -> tuple[Term, Term]:
    """The two terms of a random effect: a shared coefficient, and the deviation of each group from it.

    `by` is as in `make_term`, and `labels` [L] are the labels of the links' groups. `estimate_noise` sets the prior
    standard deviation of the deviations to the estimated spread.
    """
    deviations = make_term(links, deviations_of(name), by, labels=labels, prior=START_SPREAD)
    return make_term(links, name, by), replace(deviations, around=name)


def deviations_of(name: str) -> str:
    """Name of the term that contains the deviations of a random effect's groups from the mean."""
    return f"{name}, deviation"


def transmitters(links: Measurements) -> NDArray[np.str_]:
    """Labels [L] of the links: the position of each link's transmitter, rounded to the centimetre."""
    return np.array([",".join(f"{value:z.2f}" for value in tx) for tx in links.tx], dtype=np.str_)


def column(links: Measurements, by: str) -> NDArray[np.float64]:
    """The column of a term [L], before it is centred; see `make_term`.

    Raises:
        InputError: The links' table lacks the column, or the column is not numeric.
    """
    if by == CONSTANT:
        return np.ones(len(links))
    return np.log10(links.distance) if by == LOG_DISTANCE else links.table.numbers(by)


def _labels(name: str, links: Measurements, labels: ArrayLike) -> NDArray[np.str_]:
    array = np.asarray(labels, dtype=np.str_)
    if array.shape != (len(links),):
        raise InputError(
            f"nuisance {name!r}: labels have shape {array.shape}, but must have ({len(links)},), one label per link"
        )
    return array


@dataclass(frozen=True, eq=False)
class Nuisance:
    """A linear design [L, q]: the columns of several terms.

    Attributes:
        num_links: Number of links L.
        terms: Terms of the design; the tuple may be empty.

    Raises:
        InputError: A term has a different number of links, or two terms have the same name.
    """

    num_links: int
    terms: tuple[Term, ...] = ()

    def __post_init__(self) -> None:
        names = [term.name for term in self.terms]
        for term in self.terms:
            if len(term.value) != self.num_links:
                raise InputError(
                    f"nuisance {term.name!r}: {len(term.value)} links, must be {self.num_links} as in other terms"
                )
            if names.count(term.name) > 1:
                raise InputError(f"nuisance {term.name!r}: two terms have this name; rename one")

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns [q], term by term."""
        return tuple(name for term in self.terms for name in term.columns)

    @cached_property
    def lower(self) -> NDArray[np.float64]:
        """Lower bounds [q], [dB] per unit of the column."""
        return self._per_column([term.bounds[0] for term in self.terms])

    @cached_property
    def upper(self) -> NDArray[np.float64]:
        """Upper bounds [q], [dB] per unit of the column."""
        return self._per_column([term.bounds[1] for term in self.terms])

    @cached_property
    def prior(self) -> NDArray[np.float64]:
        """Standard deviations of the priors [q], [dB] per unit of the column; +inf for flat priors."""
        return self._per_column([term.prior for term in self.terms])

    @cached_property
    def design(self) -> sparse.csr_array:
        """The design [L, q]: the row of a link has one entry for each term that has a group containing the link."""
        parts = [sparse.csr_array((self.num_links, 0))]
        for term in self.terms:
            # A link in none of the groups has no entry.
            row = np.flatnonzero(term.group >= 0)
            entries = (term.value[row], (row, term.group[row]))
            parts.append(sparse.csr_array(entries, shape=(self.num_links, len(term.labels))))
        return sparse.csr_array(sparse.hstack(parts))

    @cached_property
    def layout(self) -> tuple[NDArray[np.int64], int, int]:
        """Order of the columns that gives the normal equations an arrowhead form.

        Columns of different groups share no link, so the groups of one grouping form diagonal blocks.

        Returns:
            The order of the columns [q], with the columns of the finest grouping first, group by group; and the numbers
            of groups and of terms of the finest grouping.
        """
        first = np.cumsum([0, *(len(term.labels) for term in self.terms)])
        by_grouping: dict[bytes, list[int]] = {}
        for index, term in enumerate(self.terms):
            by_grouping.setdefault(term.group.tobytes(), []).append(index)
        finest = max(by_grouping.values(), key=lambda terms: (len(self.terms[terms[0]].labels), len(terms)))
        groups = len(self.terms[finest[0]].labels)
        # Group by group, list the columns of all terms that have these groups.
        inner = (first[finest][None] + np.arange(groups)[:, None]).ravel()
        order = np.concatenate([inner, np.setdiff1d(np.arange(first[-1]), inner)])
        return order.astype(np.int64), groups, len(finest)

    def contribution(self, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """Contribution [n, L], [dB], of the nuisance to path loss: the design times the coefficients [n, q]."""
        return (self.design @ coefficients.T).T

    def filled(self, coefficients: NDArray[np.float64], determined: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Coefficients [n, q], with each undetermined one replaced by the mean of the determined ones of its term.

        Undetermined deviations of a random effect remain 0. `determined` [q] is the mask of the determined
        coefficients.
        """
        filled, first = coefficients.copy(), 0
        for term in self.terms:
            columns = np.arange(first, first + len(term.labels))
            first += len(term.labels)
            known, others = columns[determined[columns]], columns[~determined[columns]]
            if len(known) and not term.around:
                filled[:, others] = coefficients[:, known].mean(axis=1, keepdims=True)
        return filled

    def new_group_spread(self, block: NDArray[np.int64]) -> NDArray[np.float64]:
        """Standard deviation [L], [dB], for each link, of the random effects that no other block determines.

        `block` [L] is the index of each link's block, or -1 for a link that is not used.
        """
        variance = np.zeros(self.num_links)
        for term in self.terms:
            # If all links of a group are in one block, no other block determines the coefficient of this group.
            pairs = np.unique(np.stack([term.group, block])[:, block >= 0], axis=1)
            alone = np.bincount(pairs[0], minlength=len(term.labels)) == 1
            variance += (
                np.where(alone[term.group], (term.value * term.prior) ** 2, 0.0) if term.around else 0.0
            )
        return np.sqrt(variance)

    def by_term(
        self, coefficients: NDArray[np.float64], determined: NDArray[np.bool_]
    ) -> dict[str, dict[str, float]]:
        """Determined coefficients of all [q], by term and group; a random effect's values are mean plus deviation."""
        coefficient: dict[str, dict[str, float]] = {}
        first = 0
        for term in self.terms:
            last = first + len(term.labels)
            # A random effect's mean precedes its deviations in the order of terms.
            shared = coefficient.get(term.around, {}).get("", 0.0)
            values = zip(term.labels, coefficients[first:last].tolist(), determined[first:last], strict=True)
            coefficient[term.around or term.name] = {
                label: shared + value for label, value, known in values if known
            }
            first = last
        return coefficient

    def _per_column(self, values: list[float]) -> NDArray[np.float64]:
        return np.repeat(np.array(values, dtype=np.float64), [len(term.labels) for term in self.terms])


def study_nuisance(study: StudyModel, links: Measurements) -> Nuisance:
    """Make the nuisance that a study declares: its offset, for all links or per group, and its further terms.

    Raises:
        InputError: A term's column or groups cannot be used.
    """
    terms, offset = [], study.offset
    if offset is not None:
        terms.append(
            make_term(links, OFFSET, labels=links.group, bounds=offset.bounds, prior=offset.prior_db)
        )
    for name, term in study.nuisance.items():
        if isinstance(term.prior, str):
            terms += random_effect(links, name, term.by, links.table.labels(str(term.per)))
        else:
            labels = None if term.per is None else links.table.labels(term.per)
            terms.append(make_term(links, name, term.by, labels=labels, bounds=term.bounds, prior=term.prior))
    return Nuisance(len(links), tuple(terms))
