"""What models are worth where nothing was fitted: their errors on blocks of links, each held out in turn.

Predictions go by the materials as they were, with an offset, until another model is better by more than the bootstrap
error of the difference, which is the one-standard-error rule (L. Breiman et al., Classification and Regression Trees,
1984): first the best of the calibrated ones, and then the law of distance, which knows nothing of the scene. A few
blocks hardly tell models apart that are nearly as good, and what was fitted is further off where it does not hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.tables import Column, Table, numbers
from calibray.tables import display as glance
from calibray.validation.conformal import reach
from calibray.validation.judgement import Judgement, compare

BEFORE: Final = "before + offset"
CALIBRATED: Final = "calibrated"
PRIOR: Final = "calibrated with prior"
SLOPE: Final = "calibrated with slope"
PER_TX: Final = "calibrated, offset per transmitter"
PRIOR_PER_TX: Final = "calibrated with prior, offset per transmitter"
FIELD: Final = "calibrated with residual field"
LAW: Final = "log-distance"
KRIGING: Final = "kriging"

RIVALS: Final = (BEFORE, LAW, KRIGING)
"""Models that calibrate no material."""

FITTED: Final = (CALIBRATED, PRIOR, SLOPE, PER_TX, PRIOR_PER_TX)
"""Models that calibrate materials, and that predictions can go by."""


@dataclass(frozen=True, eq=False, repr=False)
class Validation:
    """Held-out errors of several models on the same links.

    Every link's error is that of a model that was fitted without its block. The size of errors to be expected in a
    block is that on the other blocks, so that nothing is judged by itself.

    Attributes:
        labels: Names of the blocks.
        block: Block of every link [L]; -1 where it is not judged.
        errors: Model minus measurement by name of the model [L], [dB]; NaN where it is not judged.
        position: Where the links' receivers stand [L, 3], [m].
        level: Nominal coverage of the intervals.
    """

    labels: tuple[str, ...]
    block: NDArray[np.int64]
    errors: dict[str, NDArray[np.float64]]
    position: NDArray[np.float64]
    level: float = 0.9

    def __repr__(self) -> str:
        return glance.text(*self.summary())

    def _repr_html_(self) -> str:
        return glance.html(*self.summary())

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row per model: RMSE, standard deviation [dB], log predictive density per link, and coverage."""
        return pd.DataFrame({name: self._figures(name) for name in self.errors}).T

    @property
    def best(self) -> str:
        """The model with the least held-out RMSE."""
        return str(self.table["rmse_db"].idxmin())

    @cached_property
    def chosen(self) -> str:
        """The model that predictions go by; kriging is about measured places, which blocks are not."""
        return self._chosen(self.block >= 0)

    @cached_property
    def nested_rmse_db(self) -> float:
        """RMSE of the models that are chosen by the other blocks: what choosing is worth, [dB]."""
        chosen = np.full(len(self.block), np.nan)
        for here in self._parts():
            chosen[here] = self.errors[self._chosen((self.block >= 0) & ~here)][here]
        return float(np.sqrt(np.nanmean(chosen**2)))

    @cached_property
    def judgement(self) -> Judgement:
        """The study's calibrated model beside its best rival."""
        here = self.block >= 0
        rivals = {name: self.errors[name][here] for name in RIVALS if name in self.errors}
        return compare(self.errors[CALIBRATED][here], rivals, self.position[here])

    @property
    def sentence(self) -> str:
        """Whether calibration helped where nothing was fitted, over which rival, by how much, and how sure that is."""
        return self.judgement.sentence

    def scale(self, name: str) -> float:
        """Standard deviation of a model's errors to be expected at a link outside the blocks it was fitted to.

        Args:
            name: The model.

        Returns:
            Root mean square of its held-out errors [dB].
        """
        return float(np.sqrt(np.nanmean(self.errors[name][self.block >= 0] ** 2)))

    def sizes(self, name: str) -> NDArray[np.float64]:
        """Sizes of a model's held-out errors.

        Args:
            name: The model.

        Returns:
            They, ascending [dB].
        """
        return np.sort(np.abs(self.errors[name][self.block >= 0]))

    def summary(self) -> tuple[Table | str, ...]:
        """The models side by side, and what follows.

        Returns:
            A table and two sentences.
        """
        columns = (
            Column(), numbers("RMSE", "dB"), numbers("standard deviation", "dB"), numbers("log density"),
            numbers(f"in {self.level:.0%} interval"),
        )  # fmt: skip
        rows = tuple(
            (str(name), f"{row.rmse_db:.2f}", f"{row.standard_deviation_db:.2f}", f"{row.log_density:.2f}",
             f"{row.coverage:.0%}")
            for name, row in self.table.iterrows()
        )  # fmt: skip
        title = f"{len(self.labels)} blocks held out in turn, {np.count_nonzero(self.block >= 0)} links"
        nested = f"Choosing by the other blocks each time comes to {self.nested_rmse_db:.2f} dB."
        return Table(title, columns, rows), self.sentence, f"Best: {self.best}. {self.choice} {nested}"

    @property
    def choice(self) -> str:
        """Which model predictions go by, and why, in a sentence."""
        best = self._least((BEFORE, *FITTED, LAW), self.block >= 0)
        why = "the best that tells of other places"
        if self.chosen != best:
            ground = "knows the scene" if best == LAW else "leaves materials as they were"
            why = f"which {ground} and is worse than {best!r} by no more than the bootstrap error"
        return f"Predictions go by the model {self.chosen!r}, {why}."

    def content(self) -> dict[str, Any]:
        """The validation as plain values."""
        return {
            "blocks": list(self.labels),
            "models": {str(name): row.to_dict() for name, row in self.table.iterrows()},
            "best": self.best,
            "chosen": self.chosen,
            "nested_rmse_db": self.nested_rmse_db,
            "sentence": self.sentence,
        }

    def _least(self, names: Sequence[str], here: NDArray[np.bool_]) -> str:
        """Which of some models has the least RMSE of some links."""
        known = [name for name in names if name in self.errors]
        return min(known, key=lambda name: float(np.mean(self.errors[name][here] ** 2)))

    def _chosen(self, here: NDArray[np.bool_]) -> str:
        """The choice by some links."""
        chosen = BEFORE
        for name in (self._least(FITTED, here), LAW):
            if name in self.errors:
                other = {chosen: self.errors[chosen][here]}
                told = compare(self.errors[name][here], other, self.position[here])
                chosen = name if told.gain_db > told.error_db else chosen
        return chosen

    def _parts(self) -> list[NDArray[np.bool_]]:
        return [self.block == number for number in np.unique(self.block[self.block >= 0])]

    def _figures(self, name: str) -> dict[str, float]:
        errors, density, inside = self.errors[name], [], []
        for here in self._parts():
            others = errors[(self.block >= 0) & ~here]
            size = float(np.sqrt(np.mean(others**2)))
            mine = errors[here]
            density.append(-0.5 * (mine / size) ** 2 - np.log(size * np.sqrt(2 * np.pi)))
            inside.append(np.abs(mine) <= reach(np.sort(np.abs(others)), self.level))
        judged = errors[self.block >= 0]
        return {
            "rmse_db": float(np.sqrt(np.mean(judged**2))),
            "standard_deviation_db": float(np.std(judged)),
            "log_density": float(np.mean(np.concatenate(density))),
            "coverage": float(np.mean(np.concatenate(inside))),
        }
