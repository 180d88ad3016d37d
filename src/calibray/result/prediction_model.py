"""The prediction model: what predictions, maps and exports use."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

NO_PATH: Final = "no path"
"""Beginning of the column `basis` of predictions where no path leads."""


@dataclass(frozen=True)
class FittedTerm:
    """A nuisance term with its coefficients.

    Attributes:
        name: Its name.
        by: Its column: "constant", "log_distance", or a column of the links' table.
        per: Its groups: "offset" for those of the study's offset, "transmitter", a column, or "" for none.
        coefficients: Coefficient by group, [dB] per unit of the column; groups without data have the others' mean.
        centre: What is subtracted from the column.
        spread_db: Standard deviation between groups of a random effect, [dB] per unit of the column; None for the
            standard deviation of the coefficients.
    """

    name: str
    by: str
    per: str
    coefficients: dict[str, float]
    centre: float = 0.0
    spread_db: float | None = None


@dataclass(frozen=True)
class BlockErrors:
    """Errors on new links in two levels: within blocks of neighbouring links, and common to a block.

    Attributes:
        within_db: Standard deviation of a link's own error [dB].
        between_db: Standard deviation of the error that a new block's links have in common [dB].
        blocks: Number of blocks.
        reach_m: Distance to the nearest calibration link that nine of ten held-out links kept [m].
        groups_db: Root mean square of what random effects of groups without other links add to these errors [dB].
        out_of_sight: Errors of links out of sight relative to those of all; at least 1.
    """

    within_db: float
    between_db: float
    blocks: int
    reach_m: float
    groups_db: float = 0.0
    out_of_sight: float = 1.0


@dataclass(frozen=True)
class PredictionModel:
    """A model fitted to the calibration links, and its errors on new links.

    Attributes:
        name: Its name; see `held_out.Model`.
        parameters: Values of the parameters in the fields' units; None where the model uses no scene.
        terms: Its nuisance terms.
        residual_db: Root mean square of its residuals on new links [dB]; None if there are too few links.
        basis: The links that these residuals were computed on.
        links: Number of these links, or degrees of freedom if they are calibration links.
        sizes_db: Absolute held-out residuals, ascending, at most 400 quantiles of them [dB].
        blocks: These residuals in two levels; None if no links, or too few, were held out.
    """

    name: str
    parameters: dict[str, float] | None
    terms: tuple[FittedTerm, ...] = field(default_factory=tuple)
    residual_db: float | None = None
    basis: str = ""
    links: int = 1
    sizes_db: tuple[float, ...] = ()
    blocks: BlockErrors | None = None


@dataclass(frozen=True)
class ResidualField:
    """The spatially correlated part of the residuals; see `prediction.residual_field`.

    Attributes:
        range_m: Distance at which the correlation has fallen to 1/e [m].
        shared_db: Standard deviation of the correlated part [dB].
        own_db: Standard deviation of each link's uncorrelated part [dB].
    """

    range_m: float
    shared_db: float
    own_db: float
