"""Links without a path: how many there are, and which switches of the tracer reach them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.replay import Replay
from calibray.fitting.problem import Problem
from calibray.result.remark import Remark, RemarkKind, Value
from calibray.study import Setup, Study
from calibray.support.progress import Progress

SHARE: Final = 0.02
"""Share of the links without a path from which the switches are tried: with fewer, the fit hardly changes."""

FEWEST: Final = 5
"""Links without a path from which the switches are tried; the table of rows names fewer ones."""

SAMPLE: Final = 50
"""Links that are traced again for each switch."""


def unreached_remark(problem: Problem, progress: Progress | None = None) -> tuple[Remark, ...]:
    """Count the links without a path, and try on a sample which switches of the tracer reach them.

    Args:
        problem: The problem, on stored paths.
        progress: Called with the stage "links without a path".

    Returns:
        A remark, or none if nearly all links have a path, or nothing can be traced.
    """
    setup, usable = problem.setup, np.ones(len(problem.setup.links), dtype=bool)
    for excluded in (setup.links.censored, problem.faint):
        if excluded is not None:
            usable &= ~excluded
    unreached = np.flatnonzero(usable & ~np.isfinite(problem.before))
    few = len(unreached) < max(FEWEST, SHARE * usable.sum())
    traced = setup.study.rays_path is None and isinstance(problem.engine, Replay)
    if few or setup.links.frequency is not None or not traced:
        return ()
    sample = np.sort(np.random.default_rng(0).permutation(unreached)[:SAMPLE])
    trace = setup.study.trace
    switches: dict[str, dict[str, Any]] = {"max_depth": {"max_depth": trace.max_depth + 2}}
    switches |= {name: {name: True} for name in ("diffraction", "refraction") if not getattr(trace, name)}
    reached: dict[str, int] = {}
    for number, (name, change) in enumerate(switches.items()):
        if progress is not None:
            progress("links without a path", number, len(switches))
        reached[f"{name} = {str(change[name]).lower()}"] = _reached(setup, sample, change)
    names = sorted(reached, key=lambda name: -reached[name])
    values: dict[str, Value] = {
        "links": len(unreached),
        "of": int(usable.sum()),
        "sample": len(sample),
        "switches": names,
        "reached": [float(reached[name]) for name in names],
    }
    return (Remark(RemarkKind.UNREACHED_LINKS, values),)


def _reached(setup: Setup, sample: NDArray[np.int64], change: dict[str, Any]) -> int:
    """Number of links in the sample that have a path with other settings of the tracer."""
    content = setup.study.content()
    study = Study.from_content(content | {"trace": content["trace"] | change}, setup.study.path)
    mask = np.isin(np.arange(len(setup.links)), sample)
    paths = replace(setup, study=study).at(setup.links.select(mask)).trace()
    return len(np.unique(paths.link))
