"""Replay at several carriers: one trace, and one program per carrier over the links measured there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import check_candidates
from calibray.engines.replay import Replay
from calibray.materials import Material
from calibray.parameters import Parameters
from calibray.paths import Paths


@dataclass(frozen=True, eq=False)
class CarrierPaths:
    """The paths at one carrier.

    Attributes:
        paths: The path program of the links measured there, with the constants at that carrier.
        links: Indices of these links among all links [l].
    """

    paths: Paths
    links: NDArray[np.int64]


@final
class ReplayCarriers:
    """Stored paths, evaluated at several carriers; parameters may be coefficients of laws over frequency.

    Args:
        carriers: The carriers; together they hold every link once.
        parameters: The parameters that a candidate gives values to.
        materials: The scene's materials before calibration, at the carrier of the trace.
        combining: How a link's paths combine: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".

    Raises:
        InputError: A parameter's material is not in the paths, or the combining cannot be used.
    """

    def __init__(
        self,
        carriers: Sequence[CarrierPaths],
        parameters: Parameters,
        materials: dict[str, Material],
        combining: str = "power",
        bandwidth: float | None = None,
    ) -> None:
        self.parameters, self.materials, self.calls = parameters, dict(materials), 0
        self.num_links = sum(len(carrier.links) for carrier in carriers)
        # Two coefficients of one law act on the same constant: each carrier replays the distinct constants, and
        # `_constant` maps every parameter to its constant. The mapping is the same at all carriers.
        constants = [parameters.at_carrier(carrier.paths.frequency) for carrier in carriers]
        self._constant = constants[0][1]
        self._first = np.unique(self._constant, return_index=True)[1]
        self._carriers = [
            (Replay(carrier.paths, at_carrier, combining, bandwidth), carrier.paths.frequency, carrier.links)
            for carrier, (at_carrier, _) in zip(carriers, constants, strict=True)
        ]

    @property
    def interactions(self) -> int:
        """Number of interactions that are evaluated for a candidate, over all carriers."""
        return sum(replay.interactions for replay, _, _ in self._carriers)

    @property
    def large(self) -> bool:
        """Whether some carrier has so many interactions that a candidate takes milliseconds."""
        return any(replay.large for replay, _, _ in self._carriers)

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates; see `Engine.path_loss`."""
        candidates = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(candidates), self.num_links))
        for replay, frequency, links in self._carriers:
            values, _ = self.parameters.constants_and_slopes(candidates, frequency)
            loss[:, links] = replay.path_loss(values[:, self._first])
        self.calls += len(candidates)
        return loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link and its derivatives; see `Differentiable.path_loss_and_jacobian`."""
        candidates = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(candidates), self.num_links))
        jacobian = np.empty((*loss.shape, len(self.parameters)))
        for replay, frequency, links in self._carriers:
            values, slopes = self.parameters.constants_and_slopes(candidates, frequency)
            loss[:, links], by_constant = replay.path_loss_and_jacobian(values[:, self._first])
            jacobian[:, links] = by_constant[:, :, self._constant] * slopes[:, None, :]
        self.calls += len(candidates)
        return loss, jacobian
