"""Diagnostics of the links of a finished calibration: leverage, depth, and power by material and interaction."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.replay import Replay
from calibray.fields import path_gains
from calibray.fitting.problem import Problem
from calibray.materials import Material
from calibray.paths import Kind, Paths
from calibray.result.verdict import Remark, RemarkKind, Value
from calibray.study import Setup, Study
from calibray.support.progress import Progress

DENSE: Final = 20_000_000
"""Entries of a nuisance's design up to which leverage is computed; the dense matrix then takes 160 MB."""

DIRECT: Final = "line of sight"
"""Name of the power share of paths without interactions."""


@dataclass(frozen=True)
class LinkDiagnostics:
    """Diagnostics of the links of a finished calibration.

    Attributes:
        columns: Columns for the table of links: `leverage`, NaN for a link without weight; `depth`, the number of
            interactions of the strongest path, NaN for a link without a path.
        power_shares: Mean share over the links of the power carried by paths with an interaction, by material and kind
            of interaction. A path counts in full for each of its interactions, so the sum of the shares exceeds 1.
    """

    columns: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    power_shares: dict[str, dict[str, float]] = field(default_factory=dict)


def diagnose_links(problem: Problem, best: NDArray[np.float64], paths: Paths | None) -> LinkDiagnostics:
    """Compute diagnostics of the links of a finished calibration.

    Args:
        problem: The problem.
        best: The calibrated values [d].
        paths: The paths of the calibration, at the study's carrier; None if not available.

    Returns:
        The diagnostics; columns that the engine does not allow are left out.
    """
    columns: dict[str, NDArray[np.float64]] = {}
    if problem.differentiable:
        columns["leverage"] = _leverage(problem, best)
    if paths is None or not isinstance(problem.engine, Replay) or not paths.num_paths:
        return LinkDiagnostics(columns)
    materials = problem.parameters.materials(best, problem.engine.materials)
    depth, shares = _depth_and_power(paths, materials)
    return LinkDiagnostics({**columns, "depth": depth}, shares)


def _leverage(problem: Problem, best: NDArray[np.float64]) -> NDArray[np.float64]:
    objective, count = problem.objective, problem.objective.num_counted
    optimum = problem.evaluate(problem.parameters.to_search(best)[None], derivatives=True)
    counted = np.flatnonzero(objective.weight > 0)
    root = np.sqrt(objective.weight[counted] * count / objective.weight.sum())
    columns = len(objective.nuisance.columns)
    result = np.full(len(objective.weight), np.nan)
    if count * columns <= DENSE:
        design = (
            objective.nuisance.design[counted].toarray() * root[:, None] if columns else np.zeros((count, 0))
        )
        result[counted] = leverage(optimum.slopes[0, :count], design)
    return result


def leverage(jacobian: NDArray[np.float64], design: NDArray[np.float64]) -> NDArray[np.float64]:
    """Leverage of each link: how far its model follows its own measurement.

    Args:
        jacobian: Derivatives of the residuals by the parameters, nuisance eliminated [m, d].
        design: Columns of the nuisance at the same links, scaled as the residuals [m, q].

    Returns:
        Diagonal of the projection onto both [m]: 0 for a link without influence, 1 for a link that alone determines an
        unknown. The sum is the number of unknowns that the links determine.

    Example:
        >>> leverage(np.array([[1.0], [1.0], [0.0]]), np.zeros((3, 0))).round(2).tolist()
        [0.5, 0.5, 0.0]
    """
    total = np.zeros(len(jacobian))
    for columns in (jacobian, design):
        size = np.linalg.norm(columns, axis=0)
        used = columns[:, size > 0] / size[size > 0]
        basis, values, _ = np.linalg.svd(used, full_matrices=False)
        total += np.sum(basis[:, values > 1e-6] ** 2, axis=1)
    return np.minimum(total, 1.0)


def _depth_and_power(
    paths: Paths, materials: dict[str, Material]
) -> tuple[NDArray[np.float64], dict[str, dict[str, float]]]:
    """Number of interactions of every link's strongest path [L], and power by material and kind of interaction."""
    gain = path_gains(paths, materials).reshape(paths.num_paths, -1)
    power = np.sum(np.abs(gain) ** 2, axis=1)
    count, order = np.diff(paths.first), np.lexsort((power, paths.link))
    depth = np.full(paths.num_links, np.nan)
    # The last of a link's paths in this order is its strongest.
    depth[paths.link[order]] = count[order]
    total = np.bincount(paths.link, power, paths.num_links)
    part = power / np.where(total > 0, total, np.inf)[paths.link]
    reached = max(int(np.count_nonzero(total)), 1)
    # One code per pair of material and kind; a path counts once for each pair that it meets.
    path_of = np.repeat(np.arange(paths.num_paths), count)
    code_of = paths.material.astype(np.int64) * (max(Kind) + 1) + paths.kind
    path_index, codes = np.unique(np.stack([path_of, code_of]), axis=1)
    shares: dict[str, dict[str, float]] = {}
    names = list(paths.materials)
    for code in np.unique(codes):
        material, kind = divmod(int(code), max(Kind) + 1)
        share = float(part[path_index[codes == code]].sum()) / reached
        shares.setdefault(names[material], {})[Kind(kind).name.lower()] = share
    direct = float(part[count == 0].sum()) / reached
    if direct:
        shares[DIRECT] = {"": direct}
    return depth, shares


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
