"""A study's links traced in blocks, which live here or on the workers of a cluster."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final, cast

import numpy as np

from calibray.engines.cluster.partition import block_size, chosen, of_blocks
from calibray.engines.kinds.replay import ReplaySection
from calibray.measurements import Measurements
from calibray.paths import Paths, join_links
from calibray.support.progress import Progress
from calibray.tracing import convergence
from calibray.tracing.convergence import Convergence

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Crew
    from calibray.study.setup import Setup

WORST: Final = ("rays", "last_round_db")
"""What rounds of rays tell of a block: of all blocks the largest counts."""


def traced_in_blocks(
    setup: Setup, crew: Crew, *, check: bool = False, progress: Progress | None = None
) -> tuple[Paths, Convergence | None]:
    """The paths of a study's links, traced in the blocks that a calibration has, or taken from the cache.

    Args:
        setup: The opened study.
        crew: Where blocks live.
        check: Trace each block again with twice the samples, where they are no rounds.
        progress: Called with the stage "tracing" whenever a block is done.

    Returns:
        The path program of all links, and what tracing again changed, if that was asked for.

    Raises:
        InputError: The links cannot be traced.
        EngineError: There are more paths than fit into memory, or workers die again and again.
    """
    links, size = setup.links, block_size(given_size(setup), len(setup.links))
    few = setup.at(chosen(links, np.array([0])))
    found = of_blocks(crew, partial(_traced, check), few, links, size, progress)
    paths = join_links([(block, part) for block, (part, _) in found])
    worst = {
        name: max(cast(float, part.settings[name]) for _, (part, _) in found)
        for name in WORST
        if name in paths.settings
    }
    changes = [(block, change) for block, (_, change) in found if change is not None]
    return replace(paths, settings={**paths.settings, **worst}), convergence.join(
        changes
    ) if changes else None


def given_size(setup: Setup) -> int | None:
    """Number of links of a block that a study asks for; None where it does not say.

    Args:
        setup: The opened study.

    Returns:
        The number, at most.
    """
    engine = setup.study.engine
    return engine.block_links if isinstance(engine, ReplaySection) else None


def _traced(check: bool, setup: Setup, links: Measurements) -> tuple[Paths, Convergence | None]:
    from calibray.fields import path_loss

    here = setup.at(links)
    paths = here.trace()
    if not check:
        return paths, None
    study = setup.study
    loss = partial(path_loss, combining=study.objective.combining, bandwidth=study.scene.bandwidth)
    return paths, convergence.check(here.tracer, links, paths, loss)
