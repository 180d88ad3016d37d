"""Replay at carriers: one trace, a program per carrier over the links measured there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
        links: Where these links stand among all [l].
    """

    paths: Paths
    links: NDArray[np.int64]


class ReplayCarriers:
    """Stored paths, evaluated at several carriers for any candidate; parameters may be coefficients of laws.

    Args:
        carriers: The carriers; together they hold every link once.
        parameters: What the candidates' components stand for.
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
        self._links = [carrier.links for carrier in carriers]
        self._frequencies = [carrier.paths.frequency for carrier in carriers]
        acting = [parameters.at_carrier(frequency) for frequency in self._frequencies]
        self._places = acting[0][1]  # the same at every carrier
        self._first = np.unique(self._places, return_index=True)[1]
        self._replays = [
            Replay(carrier.paths, constants, combining, bandwidth)
            for carrier, (constants, _) in zip(carriers, acting, strict=True)
        ]

    @property
    def interactions(self) -> int:
        """Interactions that a candidate is evaluated at, over all carriers."""
        return sum(replay.interactions for replay in self._replays)

    @property
    def large(self) -> bool:
        """Whether some carrier has so many interactions that a candidate costs milliseconds."""
        return any(replay.large for replay in self._replays)

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        given = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(given), self.num_links))
        for replay, frequency, links in self._carriers():
            values, _ = self.parameters.constants_and_slopes(given, frequency)
            loss[:, links] = replay.path_loss(values[:, self._first])
        self.calls += len(given)
        return loss

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss of every link, and its derivatives by the parameters.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB], and derivatives [n, L, d], [dB] per unit of the parameter.

        Raises:
            InputError: The candidates have another width, or a value is not finite.
        """
        given = check_candidates(candidates, len(self.parameters))
        loss = np.empty((len(given), self.num_links))
        jacobian = np.empty((*loss.shape, len(self.parameters)))
        for replay, frequency, links in self._carriers():
            values, slopes = self.parameters.constants_and_slopes(given, frequency)
            loss[:, links], by_constant = replay.path_loss_and_jacobian(values[:, self._first])
            jacobian[:, links] = by_constant[:, :, self._places] * slopes[:, None, :]
        self.calls += len(given)
        return loss, jacobian

    def _carriers(self) -> zip[tuple[Replay, float, NDArray[np.int64]]]:
        return zip(self._replays, self._frequencies, self._links, strict=True)
