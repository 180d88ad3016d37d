"""Observables: the quantities that are measured and modelled; path loss is the first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import Differentiable, Engine
from calibray.measurements import Measurements


@dataclass(frozen=True)
class Observable:
    """A quantity of a link that is both measured and modelled.

    Attributes:
        name: Its name in messages.
        unit: Its unit.
        measured: Its measured values [L] of given links.
        modelled: An engine's values for candidates [n, d]: [n, L], +inf where a link has no path.
        derivatives: The same with derivatives by the parameters, [n, L] and [n, L, d]; None if there are none.
    """

    name: str
    unit: str
    measured: Callable[[Measurements], NDArray[np.float64]]
    modelled: Callable[[Engine, NDArray[np.float64]], NDArray[np.float64]]
    derivatives: (
        Callable[[Differentiable, NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
        | None
    ) = None


PATH_LOSS: Final = Observable(
    "path loss",
    "dB",
    measured=lambda links: links.path_loss_db,
    modelled=lambda engine, candidates: engine.path_loss(candidates),
    derivatives=lambda engine, candidates: engine.path_loss_and_jacobian(candidates),
)
"""Path loss [dB], which the paper calibrates on."""
