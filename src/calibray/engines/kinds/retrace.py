"""Re-trace: the ray tracer runs again for every candidate, as in the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal, final

import numpy as np

from calibray.engines.section import EngineSection, OpenedStudy
from calibray.support.progress import Progress

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Workers
    from calibray.engines.retrace import Retrace
    from calibray.paths import Paths


@final
class RetraceSection(EngineSection):
    """``[engine]`` with ``name = "retrace"``.

    Attributes:
        name: "retrace".
    """

    expensive: ClassVar[bool] = True
    external: ClassVar[bool] = False

    # Sections are frozen, so a narrower type is safe.
    name: Literal["retrace"] = "retrace"  # pyright: ignore[reportIncompatibleVariableOverride]

    def answers_by(self, study: OpenedStudy) -> list[str]:
        """The versions of the ray tracer."""
        return list(study.tracer_versions.values())

    def open(
        self, study: OpenedStudy, paths: Paths | None, progress: Progress | None, workers: Workers | None
    ) -> Retrace:
        """The ray tracer over a study's links; see `EngineSection.open`."""
        from calibray.engines.retrace import CarrierTracer, Retrace

        links = study.links
        if links.frequency is None:
            tracers = [CarrierTracer(study.tracer, links, np.arange(len(links)))]
        else:
            tracers = [
                CarrierTracer(study.tracer_at(frequency), links.select(links.frequency == frequency), index)
                for frequency, index in links.carriers
            ]
        options = study.radio.combining, study.radio.bandwidth
        return Retrace(tracers, study.scene.materials, study.parameters, *options, progress)
