"""Replay: paths are traced once and evaluated for any candidate, with derivatives."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal, final

import numpy as np
from pydantic import Field

from calibray.engines.section import EngineSection, OpenedStudy
from calibray.errors import InputError
from calibray.support.messages import duration
from calibray.support.progress import Progress
from calibray.support.strict_models import Text

if TYPE_CHECKING:
    from calibray.engines.cluster.chunks import ChunkedReplay
    from calibray.engines.cluster.workers import Workers
    from calibray.engines.replay import Replay, ReplayCarriers
    from calibray.materials import Material
    from calibray.paths import Paths

_LOG: Final = logging.getLogger(__name__)

DISPLACED: Final = ("height", "dx", "dy")
"""Values of a parameter's `field` for parameters that displace antennas."""


@final
class ReplaySection(EngineSection):
    """``[engine]`` with ``name = "replay"``.

    Attributes:
        name: "replay".
        compress_db: Maximum error in path loss [dB] when a few weighted paths replace all paths; None to replay all
            paths.
        chunk_links: Maximum number of links that are traced and replayed together. If None, all links are traced
            together, unless workers are given. With workers, the default is `chunks.CHUNK_LINKS`, raised where
            necessary to keep the number of chunks at or below `chunks.MOST_CHUNKS`.
        rays: Ray table with the paths of another engine, which are used instead of traced paths.
    """

    expensive: ClassVar[bool] = False
    external: ClassVar[bool] = False
    chunked: ClassVar[bool] = True

    # Sections are immutable, so a narrower type is safe.
    name: Literal["replay"] = "replay"  # pyright: ignore[reportIncompatibleVariableOverride]
    compress_db: Annotated[float, Field(gt=0)] | None = None
    chunk_links: Annotated[int, Field(ge=1)] | None = None
    rays: Text | None = None

    def answers_by(self, study: OpenedStudy) -> None:
        """None, because replay stores no answers."""
        return

    def open(
        self, study: OpenedStudy, paths: Paths | None, progress: Progress | None, workers: Workers | None
    ) -> Replay | ReplayCarriers | ChunkedReplay:
        """The replay of a study's links; see `EngineSection.open`.

        Raises:
            InputError: The study does not allow compression, or its links cannot be traced.
        """
        # If the study does not allow compression, it is refused before anything is traced.
        self._check_compressible(study)
        if paths is None and (workers is not None or self.chunk_links is not None):
            return self._chunked(study, progress, workers)
        return replay(study, study.trace(progress=progress) if paths is None else paths, self.compress_db)

    def _chunked(
        self, study: OpenedStudy, progress: Progress | None, workers: Workers | None
    ) -> ChunkedReplay:
        from calibray.engines.cluster.chunks import ChunkedReplay, chunk_size, cut, seconds_to_trace
        from calibray.engines.cluster.workers import InProcess
        from calibray.tracing.trace_plan import LONG_TRACE_SECONDS

        displaced = [item.name for item in study.parameters if item.is_effect and item.field in DISPLACED]
        if displaced:
            raise InputError(
                f"{study.source}: parameters: {displaced[0]!r}: this parameter displaces antennas, so all links "
                "must be traced together; calibrate without workers (--workers, --scheduler) and without "
                "engine.chunk_links"
            )
        chunks = cut(study.links, chunk_size(self.chunk_links, len(study.links)))
        if workers is None and (seconds := seconds_to_trace(study, chunks)) > LONG_TRACE_SECONDS:
            _LOG.warning(
                "Tracing %s links in %d chunks; this takes about %s on two cores",
                f"{len(study.links):,}", len(chunks), duration(seconds),
            )  # fmt: skip
        opening = partial(trace_and_replay, self.compress_db)
        return ChunkedReplay(workers or InProcess(), study, chunks, opening, progress=progress)

    def _check_compressible(self, study: OpenedStudy) -> None:
        if self.compress_db is not None and (
            study.radio.combining != "power" or study.links.frequency is not None or study.parameters.has_laws
        ):
            raise InputError(
                f"{study.source}: engine.compress_db = {self.compress_db:g} requires objective.combining = 'power', "
                "a single carrier, and no coefficient of a frequency law as a parameter; remove engine.compress_db"
            )


def trace_and_replay(
    compress_db: float | None, study: OpenedStudy, materials: Mapping[str, Material]
) -> Replay | ReplayCarriers:
    """The replay of a chunk's links, whose paths are traced with the given materials; picklable, for use on workers."""
    return replay(study, study.trace(materials), compress_db)


def replay(study: OpenedStudy, paths: Paths, compress_db: float | None = None) -> Replay | ReplayCarriers:
    """The replay of an opened study from stored paths, with one program per carrier.

    `compress_db` is the maximum error in path loss [dB] when a few weighted paths replace all paths; None keeps all
    paths.
    """
    from calibray.engines.compression import compress
    from calibray.engines.replay import CarrierPaths, Replay, ReplayCarriers
    from calibray.paths import take_links

    links, parameters = study.links, study.parameters
    options = study.radio.combining, study.radio.bandwidth
    if compress_db is not None:
        paths = compress(paths, parameters, compress_db).paths
    if links.frequency is None and not parameters.has_laws:
        return Replay(paths, parameters, *options, effects=study.effects(paths))
    if links.frequency is None:
        at_carriers = [(paths, np.arange(len(links)))]
    else:
        at_carriers = [
            (take_links(paths, index).at(frequency, study.carriers[frequency]), index)
            for frequency, index in links.carriers
        ]
    carriers = [CarrierPaths(part, index, study.effects(part, index)) for part, index in at_carriers]
    return ReplayCarriers(carriers, parameters, paths.materials, *options)
