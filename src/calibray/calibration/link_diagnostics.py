"""Diagnostics of the links of a finished calibration.

The diagnostics are the leverage and depth of links, the power by material and interaction, and the tracer settings that
find paths for links without a path. Further tests show whether a missing region, groups of links or other antenna
directions explain the residuals.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pandas.api.types import is_numeric_dtype
from scipy.special import fdtrc, stdtr

from calibray.engines.cluster.chunks import Chunk, Shared, select_links
from calibray.engines.kinds.replay import replay
from calibray.engines.protocol import Chunked
from calibray.engines.replay import Replay, ReplayCarriers
from calibray.fields import path_gains
from calibray.fitting.problem import Evaluation, Problem
from calibray.fitting.search import Trail
from calibray.materials import Material
from calibray.measurements import POSITION_COLUMNS, Measurements
from calibray.paths import Kind, Paths
from calibray.result.verdict import Remark, RemarkKind, Value
from calibray.scenes.obstruction import COLUMNS as OBSTRUCTION
from calibray.scenes.obstruction import OUT_OF_SIGHT
from calibray.study import Setup, Study
from calibray.study.link_checks import LINKS_PER_UNKNOWN
from calibray.support.progress import Progress
from calibray.tracing.antennas import EVERY, POSE
from calibray.uncertainty.missing_region import missing_region
from calibray.validation.held_out_statistics import CLUSTER_LINKS, MOST_CLUSTERS, spatial_blocks

DENSE: Final = 20_000_000
"""Maximum number of entries in the nuisances' design matrix; if there are more, no leverage is computed. A matrix of
this size takes 160 MB."""

DIRECT: Final = "line of sight"
"""Label of the power share of paths without interactions."""


@dataclass(frozen=True)
class LinkDiagnostics:
    """Diagnostics of the links of a finished calibration.

    Attributes:
        columns: Columns for the table of links: `leverage` (NaN for a link of weight 0) and `depth`, the number of
            interactions of the strongest path (NaN for a link without a path).
        power_shares: Share of a link's power on paths with a given material and kind of interaction, averaged over the
            links. A path counts in full for every pair of material and kind of interaction on the path, so the sum of
            the shares can exceed 1.
    """

    columns: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    power_shares: dict[str, dict[str, float]] = field(default_factory=dict)


def diagnose_links(problem: Problem, best: NDArray[np.float64], paths: Paths | None) -> LinkDiagnostics:
    """Compute link diagnostics at the calibrated values [d]; columns that the engine cannot provide are omitted.

    `paths` are the calibration's paths at the study's carrier, if available.
    """
    columns: dict[str, NDArray[np.float64]] = {}
    if problem.differentiable:
        columns["leverage"] = _leverage(problem, best)
    engine, names = problem.engine, list(problem.engine.materials)
    if isinstance(engine, Chunked) and _at_one_carrier(problem):
        materials = problem.parameters.materials(best, engine.materials)
        parts, links = engine.ask(_chunk_power, materials), list(engine.chunks)
    elif paths is not None:
        materials = problem.parameters.materials(best, engine.materials)
        parts, links = [_depth_and_power(paths, materials)], [np.arange(problem.num_links)]
    else:
        return LinkDiagnostics(columns)
    reached, depth = sum(part.reached for part in parts), np.full(problem.num_links, np.nan)
    if not reached:
        return LinkDiagnostics(columns)
    for part, chunk in zip(parts, links, strict=True):
        depth[chunk] = part.depth
    share = np.sum([part.power for part in parts], axis=0) / reached
    shares: dict[str, dict[str, float]] = {}
    for material, kind in np.argwhere(share[:-1] > 0).tolist():
        shares.setdefault(names[material], {})[Kind(kind).name.lower()] = float(share[material, kind])
    if share[-1, 0] > 0:
        shares[DIRECT] = {"": float(share[-1, 0])}
    return LinkDiagnostics({**columns, "depth": depth}, shares)


def _at_one_carrier(problem: Problem) -> bool:
    """Whether all paths are replayed without compression, with the constants at the study's carrier."""
    compressed = getattr(problem.setup.study.engine, "compress_db", None) is not None
    return not (compressed or problem.parameters.has_laws or problem.setup.links.frequency is not None)


def _leverage(problem: Problem, best: NDArray[np.float64]) -> NDArray[np.float64]:
    objective, count = problem.objective, problem.objective.num_counted
    optimum = problem.evaluate(problem.parameters.to_search(best)[None], derivatives=True)
    counted = np.flatnonzero(objective.weight > 0)
    root = np.sqrt(objective.weight[counted] * count / objective.weight.sum())
    rows, columns = optimum.slopes[0], len(objective.nuisance.columns)
    result = np.full(len(objective.weight), np.nan)
    if len(rows) * columns <= DENSE:
        design = np.zeros((len(rows), columns))
        if columns:
            design[:count] = objective.nuisance.design[counted].toarray() * root[:, None]
            # Further rows contain the priors, which partly determine the coefficients.
            ridge = objective.noise_db / objective.nuisance.prior
            design[count : objective.num_rows] = np.diag(ridge)[ridge > 0]
        result[counted] = leverage(rows, design)[:count]
    return result


def leverage(jacobian: NDArray[np.float64], design: NDArray[np.float64]) -> NDArray[np.float64]:
    """Leverage of each of m links: the derivative of its modelled value with respect to its own measurement.

    Leverage is the diagonal of the projection onto two sets of columns: the derivatives of the residuals, with the
    nuisance eliminated [m, d], and the columns of the nuisance, scaled like the residuals [m, q]. Leverage is 0 for a
    link without influence, and 1 for a link that determines an unknown on its own. The sum of leverage over all rows,
    including the rows of priors, is the number of unknowns that the rows determine.

    Example:
        >>> leverage(np.array([[1.0], [1.0], [0.0]]), np.zeros((3, 0))).round(2).tolist()
        [0.5, 0.5, 0.0]
    """
    total = np.zeros(len(jacobian))
    for columns in (jacobian, design):
        size = np.linalg.norm(columns, axis=0)
        used = columns[:, size > 0] / size[size > 0]
        basis, values, _ = np.linalg.svd(used, full_matrices=False)
        # Columns that are linear combinations of others add nothing to the projection.
        total += np.sum(basis[:, values > 1e-6] ** 2, axis=1)
    return np.minimum(total, 1.0)


class _Power(NamedTuple):
    """Power of the paths of a set of links.

    Attributes:
        depth: Number of interactions of every link's strongest path [L].
        power: Shares of the links' power by material and kind of interaction, summed over the links [M + 1, kinds]. The
            first element of the last row is the share of paths without interactions.
        reached: Number of links with power.
    """

    depth: NDArray[np.float64]
    power: NDArray[np.float64]
    reached: int


def _depth_and_power(paths: Paths, materials: dict[str, Material]) -> _Power:
    gain = path_gains(paths, materials)
    power = np.sum(np.abs(gain) ** 2, axis=tuple(range(1, gain.ndim)))
    count, order = np.diff(paths.first), np.lexsort((power, paths.link))
    depth = np.full(paths.num_links, np.nan)
    # The last path of a link in this order is the link's strongest path.
    depth[paths.link[order]] = count[order]
    total = np.bincount(paths.link, power, paths.num_links)
    part = power / np.where(total > 0, total, np.inf)[paths.link]
    # Each pair of material and kind of interaction has one code; a path counts once for each pair that occurs on the
    # path.
    kinds = max(Kind) + 1
    path_of = np.repeat(np.arange(paths.num_paths), count)
    path_index, codes = np.unique(
        np.stack([path_of, paths.material.astype(np.int64) * kinds + paths.kind]), axis=1
    )
    shares = np.zeros((len(paths.materials) + 1, kinds))
    np.add.at(shares.reshape(-1), codes, part[path_index])
    shares[-1, 0] = part[count == 0].sum()
    return _Power(depth, shares, int(np.count_nonzero(total)))


def _chunk_power(chunk: Chunk, materials: dict[str, Material]) -> _Power:
    return _depth_and_power(cast(Replay, chunk.engine).paths, materials)


FEWEST_CLUSTERS: Final = 8
"""Minimum number of clusters with links both inside and outside a group; a group with fewer such clusters is not
tested."""

MIXED: Final = 0.5
"""Minimum share of the variance of group membership that must lie within clusters for the group to be tested; a group
with a smaller share is regarded as a location."""

SIGNIFICANCE: Final = 0.01
"""Probability of a false alarm over all groups of all columns, or over all antenna directions."""

SMALLEST_DB: Final = 0.05
"""Minimum improvement of the RMSE for which a group or a direction is reported [dB]; smaller improvements do not change
predictions noticeably."""


@dataclass(frozen=True)
class Difference:
    """A group whose residuals differ from those of neighbouring links of other groups.

    Attributes:
        column: The column.
        label: Label of the group in this column.
        difference_db: Mean residual of the group minus the mean residual of its neighbours [dB].
        error_db: Standard error [dB].
        chance: P-value of the difference, multiplied by the number of tested groups.
    """

    column: str
    label: str
    difference_db: float
    error_db: float
    chance: float


def differing_groups(
    residual_db: NDArray[np.float64], ends: NDArray[np.float64], columns: Mapping[str, NDArray[np.str_]]
) -> list[Difference]:
    """Find groups, such as the links of one device, whose residuals differ significantly from those of neighbours.

    Only neighbouring links of one transmitter are compared: residuals and group membership are taken relative to their
    means over clusters of neighbouring links. A column that is constant over a neighbourhood, such as the name of a
    street, therefore shows no difference, and errors that neighbours share cancel. Each cluster counts as one
    observation of the difference, so that correlated errors within a cluster are not treated as independent (K.-Y.
    Liang, S. L. Zeger, Biometrika 73, 1986). The most significant group comes first.

    Args:
        residual_db: Residuals [n], [dB].
        ends: Positions of transmitter and receiver [n, 6], [m].
        columns: Labels [n] by column.
    """
    count = min(max(len(ends) // CLUSTER_LINKS, 1), MOST_CLUSTERS)
    # Transmitter positions are scaled up, so that clusters rarely contain links of two transmitters.
    cluster = spatial_blocks(ends * np.repeat([1000.0, 1.0], 3), count)
    size = np.bincount(cluster)
    residual = residual_db - (np.bincount(cluster, residual_db) / size)[cluster]
    mean_square = float(np.mean(residual_db**2))
    tested: list[Difference] = []
    for column, labels in columns.items():
        names = np.unique(labels)
        # A column with more labels probably names individual links or positions.
        for name in names if 2 <= len(names) <= 50 else ():
            member = (labels == name).astype(float)
            inside = member - (np.bincount(cluster, member) / size)[cluster]
            square, variance = np.bincount(cluster, inside**2), float(np.var(member))
            mixed = int(np.count_nonzero(square))
            if mixed < FEWEST_CLUSTERS or square.sum() < MIXED * variance * len(member):
                continue
            # Regression of residuals on group membership, both relative to their means over clusters.
            difference = float(inside @ residual / square.sum())
            score = np.bincount(cluster, inside * residual) - square * difference
            error = float(np.sqrt(np.sum(score**2) * mixed / (mixed - 1)) / square.sum())
            # An offset for the group removes this part of the mean square.
            improved = np.sqrt(mean_square) - np.sqrt(max(mean_square - variance * difference**2, 0.0))
            chance = 1.0
            if improved >= SMALLEST_DB:
                chance = 2 * float(stdtr(mixed - 1, -abs(difference) / max(error, 1e-12)))
            tested.append(Difference(column, str(name), difference, error, chance))
    # Bonferroni's correction for the number of groups.
    corrected = [replace(group, chance=group.chance * len(tested)) for group in tested]
    significant = [group for group in corrected if group.chance < SIGNIFICANCE]
    return sorted(significant, key=lambda group: group.chance)


SHARE: Final = 0.02
"""Minimum share of links without a path for which other tracer settings are tried; a smaller share hardly affects the
fit."""

FEWEST: Final = 5
"""Minimum number of links without a path for which other tracer settings are tried."""


def unreached_remark(problem: Problem, progress: Progress | None = None) -> tuple[Remark, ...]:
    """Count the links without a path, and test which tracer settings find paths for a sample of these links.

    No remark is made if nearly all links have a path or if nothing can be traced. `progress` is called with the stage
    "links without a path".
    """
    setup, usable = problem.setup, np.ones(len(problem.setup.links), dtype=bool)
    for excluded in (setup.links.censored, problem.faint):
        if excluded is not None:
            usable &= ~excluded
    unreached = np.flatnonzero(usable & ~np.isfinite(problem.before))
    few = len(unreached) < max(FEWEST, SHARE * usable.sum())
    traced = setup.study.rays_path is None and isinstance(problem.engine, Replay | ReplayCarriers | Chunked)
    if few or setup.links.frequency is not None or not traced:
        return ()
    sample = np.sort(np.random.default_rng(0).permutation(unreached)[:50])
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
    """Number of links in the sample that have a path with the changed tracer settings."""
    mask = np.isin(np.arange(len(setup.links)), sample)
    changed = setup.with_trace(replace(setup.study.trace, **change))
    paths = changed.at(setup.links.select(mask)).trace()
    return len(np.unique(paths.link))


MOST_NUMBERS: Final = 12
"""Maximum number of distinct values with which a numeric column, such as the day or the floor, can label groups."""

SIGNAL_CORRELATION: Final = 0.5
"""Magnitude of the rank correlation with path loss above which whole numbers are assumed to be signal levels, not
labels."""

FEWEST_OF_TRANSMITTER: Final = 2 * LINKS_PER_UNKNOWN
"""Minimum number of links of a transmitter for its direction to be tested; a direction has two unknown angles."""

MOST: Final = 50
"""Maximum number of transmitters that are tested; those with the most links are chosen. Each transmitter requires three
derivatives of every link."""


class Direction(NamedTuple):
    """Changes of a transmitter's stated angles that would explain its residuals, with their standard errors [deg]."""

    azimuth: float
    azimuth_error: float
    downtilt: float
    downtilt_error: float


def region_remark(problem: Problem, trail: Trail) -> tuple[Remark, ...]:
    """Test whether losses in a region, for example due to unmapped trees, would explain the residuals of a calibration.

    The links must have positions. A loss that is common to all non-line-of-sight links is fitted first.
    """
    links = problem.setup.links
    if not isinstance(links, Measurements) or not problem.differentiable:
        return ()
    counted = np.flatnonzero(problem.objective.weight > 0)
    excess_db = _excess_db(problem, trail)[counted]
    known = [links.table.numbers(OUT_OF_SIGHT)[counted]] if OUT_OF_SIGHT in links.table.frame else []
    region = missing_region(links.tx[counted], links.rx[counted], excess_db, known)
    if region is None or not region.significant:
        return ()
    values = region.row()
    del values["significant"]
    return (Remark(RemarkKind.MISSING_REGION, values),)


def _excess_db(problem: Problem, trail: Trail) -> NDArray[np.float64]:
    """Measured minus modelled path loss of all links at the optimum [L], [dB], unweighted."""
    return problem.objective.measured - problem.objective.model(trail.best_modelled[None])[0]


def groups_remark(problem: Problem, trail: Trail) -> tuple[Remark, ...]:
    """Test whether the groups of a column without a nuisance, such as devices, explain the residuals of a calibration.

    Labels are text, carriers, or a few whole numbers. Numbers that correlate with path loss are assumed to be signal
    levels.
    """
    setup, links = problem.setup, problem.setup.links
    if not isinstance(links, Measurements):
        return ()
    section, counted = setup.study.links, np.flatnonzero(problem.objective.weight > 0)
    used = {*OBSTRUCTION, *POSITION_COLUMNS, *section.tx, *section.rx, section.value}
    for term in setup.study.nuisance_terms.values():
        used |= {term.by, *term.per}
    columns = {}
    frame = links.frame.loc[:, ~links.frame.columns.duplicated(keep=False)].iloc[counted]
    for name in frame.columns.difference(list(used)):
        cells = frame[name]
        if cells.notna().all() and (
            name == section.frequency
            or not is_numeric_dtype(cells)
            or _are_labels(cells, links.path_loss_db[counted])
        ):
            columns[str(name)] = cells.astype(str).to_numpy(dtype=np.str_)
    excess_db = _excess_db(problem, trail)[counted]
    differing = differing_groups(excess_db, np.hstack([links.tx, links.rx])[counted], columns)
    if not differing:
        return ()
    column = differing[0].column
    groups = [group for group in differing if group.column == column]
    values: dict[str, Value] = {
        "column": column,
        "labels": [group.label for group in groups],
        "differences_db": [group.difference_db for group in groups],
        "errors_db": [group.error_db for group in groups],
        "others": sorted({group.column for group in differing} - {column}),
        "per": [*setup.study.offset_groups, column],
        "chance": differing[0].chance,
    }
    return (Remark(RemarkKind.DIFFERING_GROUPS, values),)


def _are_labels(cells: pd.Series, path_loss_db: NDArray[np.float64]) -> bool:
    """Whether numbers can be group labels rather than signal levels."""
    if cells.dtype.kind == "c" or not 2 <= cells.nunique() <= MOST_NUMBERS or (cells % 1 != 0).any():
        return False
    correlation = cells.corr(pd.Series(path_loss_db, cells.index), method="spearman")
    return not abs(correlation) > SIGNAL_CORRELATION


def directions_remark(problem: Problem, best: NDArray[np.float64]) -> tuple[Remark, ...]:
    """Test whether transmit antenna directions other than the stated directions would explain the residuals.

    For each transmitter, an F test adds two columns to a model with the parameters, the nuisance and a gain of the
    transmitter. These columns are the derivatives of path loss with respect to azimuth and downtilt at the calibrated
    values [d]. The remark names the transmitters. No remark is made if no paths are stored.
    """
    setup, engine = problem.setup, problem.engine
    study, table = setup.study, setup.links.table
    known = any(name.startswith(POSE) for name in study.parameters)
    section = study.links.mountings.get("tx")
    stated = section is not None and section.aim is None
    if not stated or known or not _at_one_carrier(problem) or problem.observed:
        return ()
    if not isinstance(engine, Replay | Chunked) or study.links.transmitter not in table.frame:
        return ()
    labels = table.labels(study.links.transmitter)[problem.objective.weight > 0].tolist()
    tested = [
        label
        for label, count in Counter(labels).most_common(MOST)
        if count >= FEWEST_OF_TRANSMITTER and label != EVERY
    ]
    if not tested:
        return ()
    evaluation, columns = _derivatives(problem, engine, best, tested)
    directions = {}
    freedom = evaluation.num_rows - problem.unknowns
    for label in tested:
        direction = _direction(evaluation, columns, label, freedom, SIGNIFICANCE / len(tested))
        if direction is not None:
            directions[label] = direction
    if not directions:
        return ()
    numbers = {
        f"{name}_deg": [float(getattr(direction, name)) for direction in directions.values()]
        for name in Direction._fields
    }
    return (Remark(RemarkKind.ANTENNA_DIRECTIONS, {"transmitters": list(directions), **numbers}),)


def _derivatives(
    problem: Problem, engine: Replay | Chunked, best: NDArray[np.float64], transmitters: list[str]
) -> tuple[Evaluation, dict[str, int]]:
    """The evaluation with derivatives for the directions and gains of the transmitters, and each parameter's column."""
    content = problem.setup.study.content()
    poses = {
        f"{POSE}{label}.{field}": {"bounds": [-1.0, 1.0], "start": 0.0}
        for label in transmitters
        for field in ("azimuth", "downtilt", "gain")
    }
    study = Study.from_content(
        content | {"parameters": content["parameters"] | poses}, problem.setup.study.path
    )
    scene = problem.setup.scene
    parameters = study.parameter_set(scene.materials, scene.laws)
    setup = replace(problem.setup, study=study, parameters=parameters)
    values = problem.parameters.named(best)
    candidate = np.array([values.get(name, 0.0) for name in parameters.names])
    if isinstance(engine, Chunked):
        posed = engine.derived(
            parameters, _Posed(Shared(setup.at(select_links(setup.links, engine.chunks[0]))))
        )
    else:
        posed = replay(setup, engine.paths)
    trial = replace(problem, setup=setup, engine=posed, priors=study.priors)
    evaluation = trial.evaluate(parameters.to_search(candidate)[None], derivatives=True)
    return evaluation, {name: number for number, name in enumerate(parameters.names)}


@dataclass(frozen=True)
class _Posed:
    """Makes a replay of a chunk's paths for another opened study."""

    study: Shared[Setup]

    def __call__(self, chunk: Chunk) -> Replay | ReplayCarriers:
        return replay(self.study.content.at(chunk.study.links), cast(Replay, chunk.engine).paths)


def _direction(
    evaluation: Evaluation, columns: dict[str, int], label: str, freedom: int, significance: float
) -> Direction | None:
    """The change in direction that explains the residuals of one transmitter; None if it is not significant."""
    residuals, slopes = evaluation.residuals[0], evaluation.slopes[0]
    own = [columns[f"{POSE}{label}.{field}"] for field in ("azimuth", "downtilt", "gain")]
    common = [column for name, column in columns.items() if not name.startswith(POSE)]
    stated, turned = slopes[:, [*common, own[2]]], slopes[:, [*common, own[2], *own[:2]]]
    without, _, rank, _ = np.linalg.lstsq(stated, -residuals, rcond=None)
    step, _, full_rank, _ = np.linalg.lstsq(turned, -residuals, rcond=None)
    before = float(np.sum((residuals + stated @ without) ** 2))
    after = float(np.sum((residuals + turned @ step) ** 2))
    # An angle whose column is a linear combination of the other columns does not increase the rank.
    further, left = int(full_rank - rank), freedom - 1 - int(full_rank - rank)
    improvement = (np.sqrt(before) - np.sqrt(after)) / np.sqrt(len(residuals))
    if further < 1 or left < 1 or improvement < SMALLEST_DB:
        return None
    if fdtrc(further, left, (before - after) / further / max(after / left, 1e-300)) > significance:
        return None
    errors = np.sqrt(after / left * np.diag(np.linalg.pinv(turned.T @ turned)))
    return Direction(float(step[-2]), float(errors[-2]), float(step[-1]), float(errors[-1]))
