"""Re-trace: the ray tracer runs anew for every candidate, as in the paper."""

from __future__ import annotations

from concurrent.futures import Executor
from typing import TYPE_CHECKING, ClassVar, Literal, final

import numpy as np

from calibray.engines.section import EngineSection
from calibray.support.progress import Progress

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Crew
    from calibray.engines.retrace import Retrace
    from calibray.paths import Paths
    from calibray.study.setup import Setup


@final
class RetraceSection(EngineSection):
    """``[engine]`` with ``name = "retrace"``.

    Attributes:
        name: "retrace".
    """

    dear: ClassVar[bool] = True
    external: ClassVar[bool] = False

    # Sections are frozen, so that a narrower type is safe.
    name: Literal["retrace"] = "retrace"  # pyright: ignore[reportIncompatibleVariableOverride]

    def answers_by(self, setup: Setup) -> list[str]:
        """The versions of the ray tracer."""
        return list(setup.factory.versions.values())

    def open(
        self,
        setup: Setup,
        paths: Paths | None,
        progress: Progress | None,
        executor: Executor | Crew | None,
    ) -> Retrace:
        """The ray tracer over a study's links; see `EngineSection.open`."""
        from calibray.engines.retrace import CarrierTracer, Retrace

        study, links = setup.study, setup.links
        if links.frequency is None:
            parts = [CarrierTracer(setup.tracer, links, np.arange(len(links)))]
        else:
            parts = [
                CarrierTracer(setup.tracer_at(frequency), links.select(links.frequency == frequency), index)
                for frequency, index in links.carriers
            ]
        options = study.objective.combining, study.scene.bandwidth
        return Retrace(parts, setup.scene.materials, setup.parameters, *options, progress)
