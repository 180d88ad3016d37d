"""Replay: paths are traced once and evaluated for any candidate, with derivatives."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from concurrent.futures import Executor
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal, cast, final

import numpy as np
from pydantic import Field

from calibray.engines.section import EngineSection
from calibray.errors import InputError
from calibray.support.messages import duration
from calibray.support.progress import Progress

if TYPE_CHECKING:
    from calibray.engines.cluster.blocks import Blocks
    from calibray.engines.cluster.workers import Crew
    from calibray.engines.multi_carrier import ReplayCarriers
    from calibray.engines.replay import Replay
    from calibray.materials import Material
    from calibray.paths import Paths
    from calibray.study.setup import Setup

_LOG: Final = logging.getLogger(__name__)


@final
class ReplaySection(EngineSection):
    """``[engine]`` with ``name = "replay"``.

    Attributes:
        name: "replay".
        compress_db: Replay few weighted paths in place of all, with this largest error of path loss [dB]; all if None.
        block_links: Trace and replay the links in blocks of so many at most; all at once if None, or in blocks of
            `parts.BLOCK_LINKS` where workers are given, but no more than `parts.BLOCKS` of them.
    """

    dear: ClassVar[bool] = False
    external: ClassVar[bool] = False
    parted: ClassVar[bool] = True

    # Sections are frozen, so that a narrower type is safe.
    name: Literal["replay"] = "replay"  # pyright: ignore[reportIncompatibleVariableOverride]
    compress_db: Annotated[float, Field(gt=0)] | None = None
    block_links: Annotated[int, Field(ge=1)] | None = None

    def answers_by(self, setup: Setup) -> None:
        """Nothing: what is replayed is kept with the paths."""
        return

    def open(
        self,
        setup: Setup,
        paths: Paths | None,
        progress: Progress | None,
        executor: Executor | Crew | None,
    ) -> Replay | ReplayCarriers | Blocks:
        """The replay of a study's links; see `EngineSection.open`.

        Raises:
            InputError: Compression does not suit the study, or its links cannot be traced.
        """
        # Before anything is traced.
        self._check_compressible(setup)
        if paths is None and (executor is not None or self.block_links is not None):
            from calibray.engines.cluster.blocks import Blocks
            from calibray.engines.cluster.partition import block_size, cut, seconds_to_trace
            from calibray.engines.cluster.workers import Here
            from calibray.tracing.trace_plan import LONG_TRACE_SECONDS

            crew = Here() if executor is None else cast("Crew", executor)
            blocks = cut(setup.links, block_size(self.block_links, len(setup.links)))
            if executor is None and (seconds := seconds_to_trace(setup, blocks)) > LONG_TRACE_SECONDS:
                _LOG.warning(
                    "Tracing %s links in %d blocks; about %s on two cores",
                    f"{len(setup.links):,}", len(blocks), duration(seconds),
                )  # fmt: skip
            return Blocks(crew, setup, blocks, partial(_traced, self.compress_db), progress=progress)
        return replay(setup, setup.trace(progress=progress) if paths is None else paths, self.compress_db)

    def _check_compressible(self, setup: Setup) -> None:
        study = setup.study
        if self.compress_db is not None and (
            study.objective.combining != "power"
            or setup.links.frequency is not None
            or setup.parameters.has_laws
        ):
            raise InputError(
                f"{study.path}: engine.compress_db = {self.compress_db:g} needs objective.combining = 'power' and "
                "a single carrier without coefficients of laws; remove it"
            )


def _traced(
    compress_db: float | None, setup: Setup, materials: Mapping[str, Material]
) -> Replay | ReplayCarriers:
    return replay(setup, setup.trace(materials), compress_db)


def replay(setup: Setup, paths: Paths, compress_db: float | None = None) -> Replay | ReplayCarriers:
    """The replay of an opened study on stored paths.

    Args:
        setup: The opened study.
        paths: The paths of its links, at the study's carrier.
        compress_db: Largest error of path loss [dB] for which few weighted paths stand for all; all are kept if None.

    Returns:
        The engine; with a program for each carrier where the links have carriers of their own.
    """
    from calibray.engines.compression import compress
    from calibray.engines.multi_carrier import CarrierPaths, ReplayCarriers
    from calibray.engines.replay import Replay
    from calibray.paths import take_links

    study, links, parameters = setup.study, setup.links, setup.parameters
    options = study.objective.combining, study.scene.bandwidth
    if compress_db is not None:
        paths = compress(paths, parameters, compress_db).paths
    if links.frequency is None and not parameters.has_laws:
        return Replay(paths, parameters, *options)
    if links.frequency is None:
        carriers = [CarrierPaths(paths, np.arange(len(links)))]
    else:
        carriers = [
            CarrierPaths(take_links(paths, index).at(frequency, setup.carriers[frequency]), index)
            for frequency, index in links.carriers
        ]
    return ReplayCarriers(carriers, parameters, paths.materials, *options)
