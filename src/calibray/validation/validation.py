"""Validation: the accuracy of several models on blocks of links held out in turn, and the choice of a model.

Predictions use the initial materials with fitted offsets unless another model is better by more than both the bootstrap
error of the difference (the one-standard-error rule, L. Breiman et al., Classification and Regression Trees, 1984) and
5 % of the RMSE. The best calibrated model is tried first, then the log-distance model, which uses no scene. A few
blocks hardly distinguish between models of similar accuracy, and a model that was overfitted to these blocks has larger
errors elsewhere. The calibrated model without a prior must therefore be significantly better than the model with a
prior. The chosen model is averaged with a second model, because the best model on a few blocks is often not the best
elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.measurements import Measurements
from calibray.result.held_out import (
    AVERAGES,
    BASELINES,
    FITTED,
    WITHOUT_MATERIALS,
    BlockErrors,
    HeldOutErrors,
    Judgement,
    Model,
    ObservableErrors,
)
from calibray.result.wording import choice_text, judgement_text
from calibray.support.messages import percent
from calibray.tables import Column, Table, numbers, short_html, short_text
from calibray.validation.held_out_statistics import (
    choose,
    compare,
    interval_half_width,
    least,
    predicting,
    two_levels,
)


def observables_table(observables: Mapping[str, ObservableErrors]) -> Table:
    """Held-out errors of further observables, each in its own unit; no rows if there are no observables."""
    columns = (
        Column(), numbers("links"), numbers("RMSE"), numbers("RMSE of the mean"), numbers("RMSE of a law of distance"),
    )  # fmt: skip
    rows = tuple(
        (f"{name} [{errors.unit}]", str(errors.links), f"{errors.rmse:.3g}", f"{errors.mean_rmse:.3g}",
         f"{errors.distance_rmse:.3g}")
        for name, errors in observables.items()
    )  # fmt: skip
    return Table("Observables of links held out", columns, rows)


@final
@dataclass(frozen=True, eq=False, repr=False)
class Validation(HeldOutErrors):
    """Held-out errors of several models on the same links, and the conclusions from these errors.

    The error expected in a block is estimated only from the other blocks.
    """

    @classmethod
    def of(cls, errors: HeldOutErrors) -> Validation:
        """The validation with the given held-out errors."""
        if isinstance(errors, Validation):
            return errors
        return cls(
            errors.labels, errors.block, errors.errors, errors.position, errors.measured_db, errors.level,
            errors.observables,
        )  # fmt: skip

    def __repr__(self) -> str:
        return short_text(*self.summary())

    def _repr_html_(self) -> str:
        return short_html(*self.summary())

    @cached_property
    def judged(self) -> NDArray[np.bool_]:
        """Mask [links] of the links on which the models are judged."""
        return self.block >= 0

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row per model: RMSE, standard deviation [dB], log predictive density per link, and coverage.

        An average has a row only if it is the chosen model.
        """
        names = [name for name in self.errors if name == self.chosen or name not in AVERAGES]
        return pd.DataFrame({str(name): self._figures(name) for name in names}).T

    @property
    def best(self) -> str:
        """The model with the lowest held-out RMSE."""
        return str(self.table["rmse_db"].idxmin())

    @cached_property
    def chosen(self) -> str:
        """The prediction model; never kriging or the residual field, because these only help near measured links."""
        return predicting(self._on(self.judged), self.position[self.judged])

    @cached_property
    def preferred(self) -> str:
        """The model chosen by held-out residuals. Predictions average this model with a second model (see `chosen`)."""
        return choose(self._on(self.judged), self.position[self.judged])

    @cached_property
    def nested_rmse_db(self) -> float:
        """RMSE [dB] if each block is predicted by the model chosen on the other blocks."""
        errors = np.full(len(self.block), np.nan)
        for block in self._blocks():
            others = self.judged & ~block
            errors[block] = self.errors[predicting(self._on(others), self.position[others])][block]
        return float(np.sqrt(np.nanmean(errors**2)))

    @cached_property
    def judgement(self) -> Judgement:
        """Comparison of the study's calibrated model with its best baseline."""
        baselines = {name: self.errors[name][self.judged] for name in BASELINES if name in self.errors}
        return compare(self.errors[Model.CALIBRATED][self.judged], baselines, self.position[self.judged])

    @property
    def sentence(self) -> str:
        """A sentence that states by how much calibration improves on the best baseline, and how certain this is."""
        return judgement_text(self.judgement)

    @property
    def choice(self) -> str:
        """A sentence that names the model chosen for predictions and states the reason."""
        best = least(self._on(self.judged), (Model.INITIAL, *FITTED, *WITHOUT_MATERIALS))
        partner = next((name for name in AVERAGES.get(self.chosen, ())[:2] if name != self.preferred), None)
        return choice_text(self.preferred, best, partner)

    def scale(self, name: str) -> float:
        """Expected standard deviation [dB] of a model's residuals on new links: the RMS of its held-out residuals."""
        return float(np.sqrt(np.nanmean(self.errors[name][self.judged] ** 2)))

    def levels(self, name: str, links: Measurements) -> BlockErrors | None:
        """Standard deviations of a model's held-out residuals within and between blocks; None if too few links."""
        position = np.hstack([links.tx, links.rx])[self.judged]
        return two_levels(self.errors[name][self.judged], self.block[self.judged], position)

    def sizes(self, name: str) -> NDArray[np.float64]:
        """Absolute held-out residuals of a model, ascending [dB]."""
        return np.sort(np.abs(self.errors[name][self.judged]))

    def summary(self) -> tuple[Table | str, ...]:
        """Tables of the models and of further observables, the comparison with the best baseline, and the choice."""
        columns = (
            Column(), numbers("RMSE", "dB"), numbers("standard deviation", "dB"), numbers("log density"),
            numbers(f"in {percent(self.level)} interval"),
        )  # fmt: skip
        rows = tuple(
            (str(name), f"{row.rmse_db:.2f}", f"{row.standard_deviation_db:.2f}", f"{row.log_density:.2f}",
             f"{percent(row.coverage)}")
            for name, row in self.table.iterrows()
        )  # fmt: skip
        title = f"{len(self.labels)} blocks held out in turn, {np.count_nonzero(self.judged)} links"
        nested = (
            "If each block is predicted by the model chosen on the other blocks, the RMSE is "
            f"{self.nested_rmse_db:.2f} dB."
        )
        further = (observables_table(self.observables),) if self.observables else ()
        return (
            Table(title, columns, rows),
            *further,
            self.sentence,
            f"Best: {self.best}. {self.choice} {nested}",
        )

    def content(self) -> dict[str, Any]:
        """The validation as plain values."""
        observables = {name: asdict(errors) for name, errors in self.observables.items()}
        return {
            "blocks": list(self.labels),
            "models": {str(name): row.to_dict() for name, row in self.table.iterrows()},
            "best": self.best,
            "chosen": str(self.chosen),
            "nested_rmse_db": self.nested_rmse_db,
            "sentence": self.sentence,
            **({"observables": observables} if observables else {}),
        }

    def _on(self, mask: NDArray[np.bool_]) -> dict[str, NDArray[np.float64]]:
        return {name: errors[mask] for name, errors in self.errors.items()}

    def _blocks(self) -> list[NDArray[np.bool_]]:
        return [self.block == number for number in np.unique(self.block[self.judged])]

    def _figures(self, name: str) -> dict[str, float]:
        errors, log_density, inside = self.errors[name], [], []
        for block in self._blocks():
            # The error expected in this block is estimated from the other blocks.
            others = errors[self.judged & ~block]
            rms = float(np.sqrt(np.mean(others**2)))
            log_density.append(-0.5 * (errors[block] / rms) ** 2 - np.log(rms * np.sqrt(2 * np.pi)))
            inside.append(np.abs(errors[block]) <= interval_half_width(np.sort(np.abs(others)), self.level))
        judged = errors[self.judged]
        return {
            "rmse_db": float(np.sqrt(np.mean(judged**2))),
            "standard_deviation_db": float(np.std(judged)),
            "log_density": float(np.mean(np.concatenate(log_density))),
            "coverage": float(np.mean(np.concatenate(inside))),
        }
