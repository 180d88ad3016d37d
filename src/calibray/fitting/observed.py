"""Further observables in the objective; their residuals follow the residuals of path loss.

Like the rows of the priors, these residuals are scaled by a ratio of standard deviations: that of path loss errors to
that of the observable's errors. Up to constants, the sum of squares is therefore minus twice the log likelihood, in
units of the noise variance of path loss.
An unknown bias is eliminated: its estimate is the mean residual of its group.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import Engine, Observing
from calibray.errors import InputError
from calibray.measurements import Measurements
from calibray.measurements.multipath import (
    ENDINGS,
    Multipath,
    measure,
    read_impulse_responses,
    read_multipath,
)
from calibray.measurements.observables import PROFILES, SIGNED, Statistic
from calibray.study import Setup
from calibray.study.observables import FILTERED

LEAST: Final = 1e-6
"""Minimum standard deviation of an observable's errors, relative to the standard deviation of its values."""


@dataclass(frozen=True, eq=False)
class Observed:
    """One observable of the links.

    Attributes:
        name: Name of the observable in the study.
        statistic: The modelled quantity.
        measured: Measured values [L], in the study's unit; NaN for a link without a value.
        scale: Size of the study's unit in SI units.
        group: Index [L] of the group whose bias applies to each link; -1 if there is no bias.
        labels: Labels of the groups; empty if there is no bias.
        std: Standard deviation of a value's error, in the study's unit.
        stated: Whether the study states `std`.
    """

    name: str
    statistic: Statistic
    measured: NDArray[np.float64]
    scale: float
    group: NDArray[np.int64]
    labels: tuple[str, ...]
    std: float
    stated: bool

    def used(self, weight: NDArray[np.float64]) -> NDArray[np.int64]:
        """Indices of the links with a value and nonzero weight [m]."""
        return np.flatnonzero(np.isfinite(self.measured) & (weight > 0))

    def freedom(self, weight: NDArray[np.float64]) -> int:
        """Number of values minus the number of biases."""
        used = self.used(weight)
        return len(used) - (len(np.unique(self.group[used])) if self.labels else 0)

    def residuals(
        self, modelled: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Modelled minus measured values [n, m], in the study's unit, without the biases; and the biases [n, groups].

        Modelled values [n, L] are in SI units; the links have weights [L].
        """
        used = self.used(weight)
        gap = modelled[:, used] / self.scale - self.measured[used]
        # If a link has no path for a candidate, its residual is 0, and it is left out of the estimate of the biases.
        found = np.isfinite(gap)
        gap = np.where(found, gap, 0.0)
        if not self.labels:
            return gap, np.zeros((len(gap), 0))
        bias = self._means(gap, found, used)
        return np.where(found, gap - bias[:, self.group[used]], 0.0), -bias

    def slopes(self, derivative: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives [n, m, k] of the residuals, from derivatives [n, L, k] of the modelled values.

        The latter are NaN for a link without a modelled value.
        """
        used = self.used(weight)
        slope = np.moveaxis(derivative[:, used] / self.scale, 2, 1)
        found = np.isfinite(slope)
        slope = np.where(found, slope, 0.0)
        if self.labels:
            slope = np.where(found, slope - self._means(slope, found, used)[..., self.group[used]], 0.0)
        return np.moveaxis(slope, 1, 2)

    def _means(
        self, values: NDArray[np.float64], found: NDArray[np.bool_], used: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Mean [..., groups] of the finite values [..., m] over the links of each group; 0 for an empty group."""
        member = (self.group[used][:, None] == np.arange(len(self.labels))).astype(np.float64)
        return values @ member / np.maximum(found @ member, 1.0)


def observed(setup: Setup, engine: Engine) -> tuple[Observed, ...]:
    """The observables that a study states.

    Raises:
        InputError: A column cannot be used, too few links have a value, or the engine computes only path loss.
    """
    sections, links = setup.study.observables, setup.links
    if not sections:
        return ()
    if not isinstance(engine, Observing):
        raise InputError(
            f"{setup.study.path}: [observables]: the engine {setup.study.engine.name!r} computes only path loss; use "
            f"'replay' or 'command'"
        )
    every, read = [], cache(_read)
    for name, section in sections.items():
        filtered = FILTERED.format(column=section.column, name=name)
        if section.file is None:
            column = filtered if filtered in links.frame else str(section.column)
            place, measured = f"column {section.column!r}", links.table.numbers(column, gaps=True)
            if section.kind not in SIGNED and len(wrong := np.flatnonzero(measured < 0)):
                raise InputError(
                    f"{links.table.cell(int(wrong[0]), str(section.column))}: {measured[wrong[0]]:g}: a {section.kind} "
                    f"must be at least 0 {section.unit}; correct it, leave the cell empty, or add the number to "
                    "links.missing"
                )
            if section.kind in PROFILES:
                measured = section.statistic.limited(measured)
        else:
            path = setup.study.observable_paths[name]
            labels = tuple(links.table.labels(section.id).tolist())
            impulses = (section.sample_rate, section.margin_db)
            source = read(path, section.id, labels, section.compass, impulses, setup.study.links.missing)
            values = measure(source, section.statistic)
            place = f"{path}"
            measured = np.array([values.get(label, np.nan) for label in labels]) / section.scale
        if section.where is not None and filtered not in links.frame:
            measured = np.where(links.where(section.where), measured, np.nan)
        count = int(np.isfinite(measured[~setup.held_out]).sum())
        if count < 2:
            raise InputError(
                f"{links.source}: {place} of [observables.{name}] must have values for two or more calibration "
                f"links, but has {count}; add measurements, or change [holdout]"
            )
        group, labels = _groups(links, section.bias)
        # If all values are equal, their standard deviation is 0; use 1 until the error is estimated from the residuals.
        std = float(np.nanstd(measured)) or 1.0 if section.std is None else section.std
        every.append(
            Observed(
                name, section.statistic, measured, section.scale, group, labels, std, section.std is not None
            )
        )
    return tuple(every)


def _read(
    path: Path,
    label: str,
    links: tuple[str, ...],
    compass: bool,
    impulses: tuple[float | None, float],
    missing: tuple[float, ...],
) -> Multipath:
    if path.is_dir() or path.suffix.lower() in ENDINGS:
        return read_impulse_responses(path, list(links), *impulses)
    return read_multipath(path, label, compass, missing)


def _groups(links: Measurements, bias: str | None) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    if bias is None:
        return np.full(len(links), -1), ()
    if bias == "all":
        return np.zeros(len(links), dtype=np.int64), ("",)
    labels, group = np.unique(links.table.labels(bias), return_inverse=True)
    return group.reshape(-1), tuple(map(str, labels))


def with_errors(
    every: tuple[Observed, ...], modelled: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[Observed, ...]:
    """The observables, with errors that the study does not state estimated from the residuals.

    Modelled values [K, L] are in SI units; the links have weights [L].
    """
    updated = []
    for observable, values in zip(every, modelled, strict=True):
        if observable.stated:
            updated.append(observable)
            continue
        residuals, _ = observable.residuals(values[None], weight)
        freedom = observable.freedom(np.where(np.isfinite(values), weight, 0.0))
        std = float(np.sqrt(np.sum(residuals**2) / max(freedom, 1)))
        updated.append(
            replace(observable, std=max(std, LEAST * float(np.nanstd(observable.measured)), 1e-300))
        )
    return tuple(updated)
