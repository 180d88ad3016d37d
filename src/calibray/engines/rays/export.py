"""The rays that one RT call returns, and an engine that keeps the rays of its calls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.external.exchange import RESPONSE
from calibray.engines.ledger.database import key
from calibray.engines.ledger.recorded import Recorded
from calibray.engines.protocol import Answering, check_candidates
from calibray.engines.rays.compile import RaySetting, compile_rays, powers
from calibray.engines.rays.table import RayTable, parse_rays
from calibray.engines.section import OpenedStudy
from calibray.errors import EngineError, InputError
from calibray.materials import Material
from calibray.parameters import Parameters
from calibray.paths import Paths

FAINT: Final = 0.1
"""Constant added to every path's share of its link's power, so that even the weakest paths have some weight."""


@dataclass(frozen=True, eq=False)
class Export:
    """The rays of one RT call.

    Attributes:
        paths: The rays as a path program, which reproduces the engine's powers at the scene's constants.
        level_db: Power of every path [P], [dB].
    """

    paths: Paths
    level_db: NDArray[np.float64]

    @classmethod
    def of(cls, study: OpenedStudy, response: bytes) -> Export:
        """Read and check the response of a program.

        Raises:
            InputError: The response is not a ray table, contains no power, or contradicts the scene or the links.
        """
        return cls.of_table(RayTable.of(parse_rays(response, RESPONSE)), RaySetting.of(study))

    @classmethod
    def of_table(cls, table: RayTable, setting: RaySetting) -> Export:
        """Compile the rays of a call.

        Raises:
            InputError: The rays have no power, or contradict the scene or the links.
        """
        if table.power is None:
            raise InputError(f"{table.source}: the table states no power for its paths; add power_db")
        paths = compile_rays(table, setting)
        return cls(paths, 10 * np.log10(powers(paths)))

    @property
    def path_loss_db(self) -> NDArray[np.float64]:
        """The engine's path loss [L], [dB]; +inf for a link without a path."""
        power = np.bincount(self.paths.link, 10 ** (self.level_db / 10), self.paths.num_links)
        with np.errstate(divide="ignore"):
            return -10 * np.log10(power)

    @property
    def weight(self) -> NDArray[np.float64]:
        """Weight of every path [P]: its share of the link's power, plus a small constant."""
        power = 10 ** (self.level_db / 10)
        return power / np.bincount(self.paths.link, power)[self.paths.link] + FAINT


@final
class Exporting:
    """An engine that returns rays and keeps them, so that each candidate requires only one call.

    Attributes:
        parameters: The parameters whose values a candidate contains.
        materials: The scene's materials before calibration.
    """

    def __init__(self, engine: Answering, study: OpenedStudy) -> None:
        self.parameters: Parameters = engine.parameters
        self.materials: dict[str, Material] = engine.materials
        self._engine, self._study = engine, study
        self._exports: dict[bytes, Export] = {}

    @property
    def calls(self) -> int:
        """Number of RT calls so far: one for each candidate that the engine itself has run."""
        return self._engine.calls

    @property
    def hits(self) -> int:
        """Number of candidates so far whose answers came from the ledger."""
        return self._engine.hits if isinstance(self._engine, Recorded) else 0

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates; see `Engine.path_loss`."""
        return np.stack([self.export(candidate).path_loss_db for candidate in candidates])

    def export(self, candidate: NDArray[np.float64]) -> Export:
        """The rays for a candidate [d].

        Raises:
            EngineError: The call failed.
        """
        if (name := key(candidate)) not in self._exports:
            (answer,) = self._engine.answers(check_candidates(candidate[None], len(self.parameters)))
            if answer.failure:
                # The run ends here, and the next run must repeat the call.
                if isinstance(self._engine, Recorded):
                    self._engine.forget_failures()
                raise EngineError(
                    f"{answer.failure}. Ray mapping needs this call: correct the program, and start again"
                )
            self._exports[name] = Export.of(self._study, answer.rays)
        return self._exports[name]
