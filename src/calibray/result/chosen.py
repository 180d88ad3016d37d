"""The model that did best where nothing was fitted: what prediction goes by."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ChosenTerm:
    """A nuisance of the model that was chosen.

    Attributes:
        name: Its name.
        by: "constant", "log_distance", or a column of the links' table.
        per: What its groups are: "offset" for those of the study's offset, "transmitter", a column, or "" for none.
        coefficients: Coefficient by group, [dB] per unit of the column; of groups that no link told, the others' mean.
        centre: What was taken off the column.
    """

    name: str
    by: str
    per: str
    coefficients: dict[str, float]
    centre: float = 0.0


@dataclass(frozen=True)
class Chosen:
    """A model, fitted to all links that count.

    Attributes:
        name: Its name, as validation gives it.
        parameters: Values of the parameters in the fields' units; None where the model knows no scene.
        terms: Its nuisances.
        residual_db: Standard deviation of its errors on blocks held out in turn [dB].
        basis: What that was taken from.
        links: Number of links that it was taken from.
        sizes_db: Sizes of these errors, ascending, evenly taken where they are many [dB]; empty in older results.
    """

    name: str
    parameters: dict[str, float] | None
    terms: tuple[ChosenTerm, ...] = field(default_factory=tuple)
    residual_db: float = 0.0
    basis: str = ""
    links: int = 1
    sizes_db: tuple[float, ...] = ()
