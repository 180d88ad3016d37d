"""Populations of transmitters: a common value and one deviation each, with a spread that is stated or estimated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from calibray.tracing.mounting import NEW, POSE

if TYPE_CHECKING:
    from calibray.measurements import Measurements
    from calibray.study.model import StudyModel

FIRST_SPREAD: Final = 0.25
"""Spread before it is estimated, as a share of the width of the bounds: nearly that of a uniform distribution, 0.29."""


def estimated_fields(study: StudyModel) -> tuple[str, ...]:
    """The fields of transmitters whose spread is estimated."""
    return tuple(
        name.rpartition(".")[2] for name, entry in study.parameters.items() if entry.spread == "auto"
    )


def with_population(study: StudyModel, links: Measurements) -> dict[str, Any]:
    """The content of a study with a parameter of every transmitter for each `spread`.

    One more stands for transmitters without measured links: its prior, which no link narrows, is the population.

    Raises:
        InputError: The column of transmitters is missing.
    """
    content = study.content()
    labels = np.unique(links.table.labels(study.links.transmitter)).tolist()
    for name, entry in study.parameters.items():
        if entry.spread is None:
            continue
        lower, upper = entry.bounds
        std = FIRST_SPREAD * (upper - lower) if entry.spread == "auto" else entry.spread
        for label in (*labels, NEW):
            own = {"bounds": [lower, upper], "prior": {"std": std, "shared": True}}
            content["parameters"].setdefault(f"{POSE}{label}.{name.rpartition('.')[2]}", own)
    return content


def with_spreads(study: StudyModel, spreads: Mapping[str, float]) -> dict[str, Any]:
    """The content of a study with standard deviations of the transmitters' values by field."""
    content = study.content()
    for name, entry in content["parameters"].items():
        field = name.rpartition(".")[2]
        if field in spreads and entry.get("prior", {}).get("shared"):
            entry["prior"]["std"] = spreads[field]
    return content
