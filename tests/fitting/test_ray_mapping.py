"""Ray mapping: an engine with other antennas and physics is understood from the powers of its rays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.constants import speed_of_light
from scipy.optimize import least_squares

import synthetic
import two_ray
from calibray.engines import Replay
from calibray.engines.rays.compile import RaySetting, compile_rays, powers, rays_of
from calibray.engines.rays.export import Export
from calibray.engines.rays.table import RayTable
from calibray.fitting import ray_fit, ray_mapping, ray_scan
from calibray.fitting.problem import Problem
from calibray.fitting.ray_fit import understand
from calibray.fitting.ray_mapping import RayMap, map_rays
from calibray.fitting.ray_model import ANGLES, BATCH, HALF_SPACE, LEAST_DB, Call, Ends, RayModel
from calibray.materials import Material
from calibray.optimizers.evaluations import Best
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind, Paths, take
from calibray.paths.chains import spherical_basis
from calibray.result.wording import remark_text
from calibray.study import Setup
from calibray.tracing.settings import Antenna

TRUTH = 7.7
SLAB = Material(3.0, 0.004, 0.437)
WALLS = Parameters((Parameter("walls.relative_permittivity", 1.5, 12.0, 4.0),))


@dataclass(frozen=True)
class Foreign:
    """An engine whose antennas and ground the study does not know; it answers with rays."""

    problem: Problem
    paths: Paths
    table: RayTable
    ripple: float = 0.0

    def __call__(self, candidate: np.ndarray) -> Export:
        return Export.of_table(self.rays(candidate), RaySetting.of(self.problem.setup))

    def rays(self, candidate: np.ndarray) -> RayTable:
        materials = self.problem.parameters.materials(candidate, self.paths.materials)
        power = powers(replace(self.paths, materials=materials))
        count = np.arange(len(power))
        return replace(self.table, power=power * 10 ** (self.ripple * np.sin(3 * candidate[0] + count)))


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Foreign:
    setup = Setup.open(
        two_ray.study(tmp_path_factory.mktemp("study"), objective={"combining": "power"}, antennas={}),
        two_ray.TwoRay,
    )
    paths = setup.trace()
    table = rays_of(paths)
    antennas = Antenna("tr38901", "H", (0.5, 0.2, 0.0)), Antenna("iso", "H")
    bare = compile_rays(
        replace(table, power=None), RaySetting(setup.scene, setup.radio.frequency, antennas, setup.links)
    )
    ground = Material(3.0, 0.02, HALF_SPACE)
    bare = replace(bare, materials={**bare.materials, "ground": ground})
    engine = Replay(bare, setup.parameters)
    measured = engine.path_loss(np.array([[TRUTH]]))[0]
    problem = Problem.of(setup, Replay(paths, setup.parameters))
    return Foreign(replace(problem, objective=replace(problem.objective, measured=measured)), bare, table)


def two_calls(foreign: Foreign, ground: Material) -> list[Call]:
    """Two calls of the engine with another ground."""
    engine = replace(
        foreign, paths=replace(foreign.paths, materials={**foreign.paths.materials, "ground": ground})
    )
    return [Call(np.array([value]), engine(np.array([value]))) for value in (4.0, 9.0)]


@pytest.fixture(scope="module", autouse=True)
def _small_scans() -> Iterator[None]:
    """Scans have room for the reflections of these links, and all tests share their compiled functions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ray_scan, "SCANNED", 30)
        yield


@pytest.fixture(scope="module")
def mapped(foreign: Foreign) -> RayMap:
    return map_rays(foreign.problem, foreign)


@pytest.fixture(scope="module")
def strange(foreign: Foreign) -> tuple[RayMap, ...]:
    """An engine of other physics, after three calls and after one more.

    Any gap is accepted, as after a step that is too short to show how well the model predicts. No scan finds what this
    engine does.
    """
    finished: list[RayMap] = []
    finish = ray_mapping._finish
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ray_fit, "TRIALS", 0)
        patch.setattr(ray_fit, "_scanned", lambda *_: [])
        patch.setattr(
            ray_mapping, "_finish", lambda *arguments: finished.append(finish(*arguments)) or finished[-1]
        )
        last = map_rays(foreign.problem, replace(foreign, ripple=0.1), tolerance_db=10.0, most_calls=4)
    assert last is finished[-1]
    return tuple(finished)


def test_three_calls_find_the_truth_of_an_engine_that_differs(mapped: RayMap, foreign: Foreign) -> None:
    assert len(mapped.calls) == 3
    assert mapped.calls[-1].candidate[0] == pytest.approx(TRUTH, rel=1e-3)
    assert mapped.understood
    assert mapped.gap_db < 0.01
    assert mapped.changed == 0
    # Its replay stands for the engine elsewhere, too.
    loss = -10 * np.log10(np.bincount(foreign.paths.link, foreign.rays(np.array([4.4])).power))
    np.testing.assert_allclose(mapped.engine.path_loss(np.array([[4.4]]))[0], loss, atol=0.02)


def test_a_slab_is_found_among_its_resonances(foreign: Foreign) -> None:
    """The study assumes 1 m and 0.5 S/m, where no wave comes back through the slab."""
    calls = two_calls(foreign, SLAB)
    found = understand(foreign.problem.parameters, calls, known=False)
    assert ray_fit.half_spaces(found, calls) == ()
    constants = found.model.described(found.values, ())
    assert found.misfit_db < 0.01
    assert constants["ground.thickness"] == pytest.approx(SLAB.thickness, rel=1e-3)
    assert constants["ground.conductivity"] == pytest.approx(SLAB.conductivity, rel=0.05)


@pytest.mark.filterwarnings("error")
def test_a_division_by_zero_in_the_solver_is_not_announced(
    foreign: Foreign, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SciPy divides by zero if the Jacobian is rank-deficient."""

    def dividing(*arguments: object, **options: object) -> object:
        assert np.isinf(np.divide(np.ones(1), np.zeros(1)))
        return least_squares(*arguments, **options)

    calls = two_calls(foreign, SLAB)
    model = RayModel.of(foreign.problem.parameters, calls[-1].export.paths, known=False)
    fit = ray_fit.Understanding(model, model.start, (False, False), np.inf)
    monkeypatch.setattr(ray_fit, "least_squares", dividing)
    assert np.isfinite(ray_fit.refined(fit, ray_fit.ratios_of(calls), calls[-1], 2).misfit_db)


def test_a_thickness_that_changes_no_ratio_is_not_stated(foreign: Foreign) -> None:
    """The wave decays by 2.5 Np in the assumed slab, but a half-space explains the ratios at least as well."""
    calls = two_calls(foreign, Material(3.0, 0.2, HALF_SPACE))
    found = understand(foreign.problem.parameters, calls, known=False)
    values = found.values.copy()
    values[found.model.assumed.index(("ground", "thickness"))] = np.log(0.2)
    assert ray_fit.half_spaces(replace(found, values=values), calls) == ("ground",)
    assert list(found.model.described(values, ("ground",))) == ["ground.conductivity"]


@pytest.fixture(scope="module")
def wrong(foreign: Foreign) -> tuple[list[Call], ray_fit.Understanding, int]:
    """Two calls, a wrong minimum three half wavelengths from the true thickness, and the thickness's index."""
    calls = two_calls(foreign, SLAB)
    truth = understand(foreign.problem.parameters, calls, known=False)
    values, at = truth.values.copy(), truth.model.assumed.index(("ground", "thickness"))
    values[at] = np.log(
        SLAB.thickness
        + 3 * speed_of_light / foreign.paths.frequency / (2 * np.sqrt(SLAB.relative_permittivity))
    )
    found = ray_fit.refined(replace(truth, values=values), ray_fit.ratios_of(calls), calls[-1], 30)
    assert found.misfit_db > 0.02
    return calls, found, at


@pytest.mark.parametrize(
    ("limit", "number", "exact"), [("TRIALS", 100, True), ("TRIALS", 0, False), ("TRIED_PATHS", 59, False)]
)
def test_another_resonance_leads_to_the_truth(
    wrong: tuple[list[Call], ray_fit.Understanding, int],
    monkeypatch: pytest.MonkeyPatch,
    limit: str,
    number: int,
    exact: bool,
) -> None:
    """The search starts in a wrong minimum."""
    calls, start, at = wrong
    monkeypatch.setattr(ray_fit, limit, number)
    found = ray_fit._hopped([start], ray_fit.ratios_of(calls), calls[-1])
    assert (found.misfit_db <= ray_fit.EXACT_DB) == exact
    if exact:
        assert np.exp(found.values[at]) == pytest.approx(SLAB.thickness, rel=1e-2)


@pytest.mark.parametrize(("ground", "same"), [(None, True), (SLAB, False)])
def test_other_antennas_alone_need_no_scan(
    foreign: Foreign, monkeypatch: pytest.MonkeyPatch, ground: Material | None, same: bool
) -> None:
    """The study's constants are among the starts of the search, with the polarizations that suit them."""
    monkeypatch.setattr(ray_fit, "_scanned", lambda *_: [])
    monkeypatch.setattr(ray_fit, "TRIALS", 0)
    declared = foreign.problem.setup.scene.materials["ground"]
    calls = two_calls(foreign, ground or declared)
    found = understand(foreign.problem.parameters, calls, known=False)
    assert (found.misfit_db < 1e-6) == same


def test_values_that_no_ratio_shows_stay(foreign: Foreign) -> None:
    """Without polarization no power depends on a slant; a value that drifts would be where the next scan starts."""
    calls = [Call(np.array([value]), foreign(np.array([value]))) for value in (4.0, 9.0)]
    model = RayModel.of(foreign.problem.parameters, calls[-1].export.paths, False)
    slants = len(model.assumed) + np.array([0, ANGLES])
    start = model.start.copy()
    start[slants] = 0.3
    fit = ray_fit.Understanding(model, start, (False, False), np.inf)
    refined = ray_fit.refined(fit, ray_fit.ratios_of(calls), calls[-1], 12)
    np.testing.assert_array_equal(refined.values[slants], 0.3)
    assert not np.array_equal(refined.values, start)


@pytest.mark.parametrize("linear", [(True, False), (False, True)])
def test_levels_are_those_of_the_replay_and_slopes_their_differences(linear: Ends) -> None:
    """With a constant for the number of ports; with every kind of interaction."""
    candidates = [np.array([3.3]), np.array([7.1])]
    model = RayModel.of(WALLS, synthetic.program(synthetic.EVERY_KIND, seed=5, ports=(2, 2)), False)
    values = model.start + 0.1 * np.random.default_rng(0).uniform(-1, 1, len(model.start))
    tables = model.tables(candidates)
    level, slope = model.levels_and_slopes(tables, values, linear)
    for candidate, mine in zip(candidates, level, strict=True):
        replayed = 10 * np.log10(powers(model.replay_paths(candidate, values, linear)))
        np.testing.assert_allclose(mine - replayed, -10 * np.log10(2) * linear[0], atol=1e-10)
    for index in range(len(values)):
        step = 1e-5 * np.eye(len(values))[index]
        above, below = (model.levels_and_slopes(tables, values + sign * step, linear)[0] for sign in (1, -1))
        np.testing.assert_allclose(slope[..., index], (above - below) / 2e-5, atol=1e-5)


def test_many_candidates_have_the_levels_of_each() -> None:
    model = RayModel.of(WALLS, synthetic.program(synthetic.EVERY_KIND, seed=5, ports=(2, 2)), False)
    tables = model.tables([np.array([value]) for value in np.linspace(2.0, 11.0, BATCH + 3)])
    together = model.levels_and_slopes(tables, model.start, (True, False))
    for number, table in enumerate(tables):
        alone = model.levels_and_slopes(table[None], model.start, (True, False))
        for whole, part in zip(together, alone, strict=True):
            np.testing.assert_allclose(whole[number], part[0], rtol=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_the_loss_of_a_scan_is_that_of_the_model_at_its_minima(known: bool) -> None:
    """For all polarizations of upright antennas, with fewer paths than a scan has room for."""
    random = np.random.default_rng(4)
    kinds = [(), (Kind.SPECULAR,), (Kind.REFRACTION, Kind.SPECULAR), (Kind.SPECULAR,) * 3, (Kind.REFRACTION,)]
    paths = synthetic.program(2 * kinds, seed=6, ports=(2, 2))
    model, candidates = RayModel.of(WALLS, paths, known), [np.array([3.3]), np.array([7.1])]
    last, earlier = (model.materials(each) for each in candidates)
    weight, change_db = random.random(len(paths.link)), random.normal(0.0, 2.0, len(paths.link))
    fields = ["thickness", "conductivity"]
    observed = ray_scan.Observed(earlier, weight, change_db)
    found = ray_scan.scan(paths, "walls", fields, last, [observed], known)
    for pair, slants in enumerate([(None, None)] if known else ray_scan.POLARIZATIONS):
        angles = [part for slant in slants for part in (slant or 0.0, 0.0, 0.0)]
        values = model.start.copy() if known else np.concatenate([model.start[: len(model.assumed)], angles])
        for field, value in zip(fields, found.values[pair, 0], strict=True):
            values[model.assumed.index(("walls", field))] = value
        linear = slants[0] is not None, slants[1] is not None
        now, before = model.levels_and_slopes(model.tables(candidates), values, linear)[0]
        square = (now - before - change_db) ** 2
        loss = np.average(square / (1 + square / ray_scan.ROBUST_DB**2), weights=weight)
        assert found.misfit[pair, 0] == pytest.approx(loss, rel=1e-4)


def test_constants_that_silence_an_engines_path_are_no_explanation() -> None:
    """Behind a slab that no wave crosses, all ratios are 1, as behind a slab that no parameter changes."""
    paths = synthetic.program([(Kind.SPECULAR,), (Kind.REFRACTION,), (Kind.REFRACTION,)] * 4, seed=6)
    model, first, last = RayModel.of(WALLS, paths, True), np.array([3.3]), np.array([7.1])

    def call(candidate: np.ndarray) -> Call:
        replayed = replace(paths, materials=model.materials(candidate))
        return Call(candidate, Export(paths, 10 * np.log10(powers(replayed))))

    calls = [call(first), call(last)]
    names = list(paths.materials)
    crossed = {names[index] for index in np.unique(paths.material[paths.kind == Kind.REFRACTION])}
    silent = model.start.copy()
    for number, (name, field) in enumerate(model.assumed):
        silent[number] = np.log(HALF_SPACE) if name in crossed and field == "thickness" else silent[number]
    ratios = ray_fit.ratios_of(calls)
    misfit = [
        ray_fit.refined(
            ray_fit.Understanding(model, values, (False, False), np.inf), ratios, calls[-1], 1
        ).misfit_db
        for values in (model.start, silent)
    ]
    assert misfit[0] < 1e-6
    assert misfit[1] > 10.0


@pytest.mark.parametrize("amplitude", [0.0, 1e-20])
def test_a_path_without_power_has_the_least_level_and_no_slope(amplitude: float) -> None:
    paths = synthetic.program(synthetic.EVERY_KIND, seed=5, ports=(2, 2))
    silent = paths.tx_field.copy()
    silent[1] *= amplitude
    model = RayModel.of(WALLS, replace(paths, tx_field=silent), False)
    level, slope = model.levels_and_slopes(model.tables([np.array([3.3])]), model.start, (True, False))
    assert level[0, 1] == LEAST_DB
    assert not slope[0, 1].any()
    assert (level[0, [0, *range(2, len(level[0]))]] > LEAST_DB).all()


def test_values_at_the_bounds_make_materials() -> None:
    """Foam with half its permittivity would have less than that of a vacuum."""
    materials = synthetic.MATERIALS | {"ground": Material(1.2, 0.001, 0.1)}
    paths = synthetic.program(synthetic.EVERY_KIND, seed=5, ports=(2, 2), materials=materials)
    model = RayModel.of(WALLS, paths, False)
    for values in model.bounds:
        assert model.materials(np.array([3.3]), values)["ground"].relative_permittivity >= 1.0


def test_paths_around_both_edges_of_a_thin_wall_are_not_mixed_up() -> None:
    """Their points are closer together than the tolerance for points that are the same."""
    paths = synthetic.program([(Kind.DIFFRACTION,)] * 2, links=1)
    paths = replace(paths, vertex=np.array([[0.0, 0.0, 2.0], [0.01, 0.0, 2.0]]))
    for index in ([0, 1], [1, 0], [1]):
        here, there = ray_fit.common(paths, take(paths, np.array(index)))
        np.testing.assert_array_equal(there, [index.index(number) for number in here])
        np.testing.assert_array_equal(here, sorted(index))


def test_a_ray_of_power_zero_is_absent(foreign: Foreign) -> None:
    table = foreign.rays(np.array([4.0]))
    power = table.power.copy()
    power[0] = 0.0
    setting = RaySetting.of(foreign.problem.setup)
    export = Export.of_table(replace(table, power=power), setting)
    rest = Export.of_table(table.take(np.arange(1, len(power))), setting)
    np.testing.assert_array_equal(export.level_db, rest.level_db)
    np.testing.assert_array_equal(export.paths.link, rest.paths.link)


@pytest.mark.parametrize(("slant", "cross"), [(np.pi / 2, 0.2), (3 * np.pi / 4, 0.05), (0.0, 0.2)])
def test_tilted_antennas_are_found_among_the_minima_near_their_nulls(slant: float, cross: float) -> None:
    """A local search from upright antennas ends in a wrong minimum; the scan reaches the truth."""
    random, count = np.random.default_rng(0), 60
    bases = []
    for _ in range(2):
        direction = random.standard_normal((count, 3)) * [1.0, 1.0, 0.15]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        theta = spherical_basis(direction)
        bases.append(np.stack([theta, np.cross(direction, theta)], axis=1))
    shape, coupling = (count, 2, 2), np.array([[1.0, cross], [cross, 1.0]])
    last, earlier = (
        np.exp(2j * np.pi * random.random(shape)) * random.random(shape) * coupling for _ in range(2)
    )
    part = ray_scan.Gains(last, earlier, (bases[0], bases[1]), np.full(count, 1 / count), np.zeros(count))
    truth = np.array([np.pi / 2, 0.08, -0.06, slant, 0.0, 0.0])
    parts = [part._replace(observed=ray_scan.errors([part], truth))]
    upright = np.array([np.pi / 2, 0.0, 0.0, slant, 0.0, 0.0])
    local = least_squares(lambda angles: ray_scan.errors(parts, angles), upright, loss="soft_l1").x
    assert np.linalg.norm(ray_scan.errors(parts, local)) > 1.0
    difference = ray_scan.antennas(parts, local)[0] - truth
    slants = [0, ANGLES]
    difference[slants] -= np.pi * np.round(difference[slants] / np.pi)
    np.testing.assert_allclose(difference, 0.0, atol=1e-6)


def test_an_engine_of_other_physics_is_not_understood(foreign: Foreign, strange: tuple[RayMap, ...]) -> None:
    first = strange[0]
    assert not first.reached
    assert not first.understood
    assert first.understanding.misfit_db > 0.2
    # It agrees with the engine at the best call nevertheless.
    last = first.best
    np.testing.assert_allclose(
        first.engine.path_loss(last.candidate[None])[0], last.export.path_loss_db, atol=1e-6
    )
    # What is left to gain is the difference to the replay's minimum.
    bounds = foreign.problem.parameters.search_bounds
    grid = np.append(foreign.problem.parameters.from_search(np.linspace(*bounds, 20_001)), last.candidate)[
        :, None
    ]
    value = foreign.problem.objective.value(first.engine.path_loss(grid))
    assert first.remaining_db == pytest.approx(value[-1] - value.min(), rel=0.02)
    assert first.remaining_db > 1e-3


def test_calls_go_on_while_the_minimum_is_not_at_the_best_call(
    foreign: Foreign, mapped: RayMap, strange: tuple[RayMap, ...]
) -> None:
    first, last = strange
    assert len(first.calls) == 3
    assert first.moved_db > 0.05
    lowest = foreign.problem.parameters.from_search(first.minima[:1])
    best, moved = first.engine.path_loss(np.vstack([first.best.candidate, lowest]))
    assert first.moved_db == pytest.approx(np.sqrt(np.mean((moved - best) ** 2)))
    assert len(last.calls) == 4
    assert len(mapped.calls) == 3


def test_the_assumptions_are_searched_at_most_four_times(
    foreign: Foreign, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No assumptions explain this engine, so each search would end without success, after minutes."""
    search, searched = ray_fit._search, []

    def counted(*arguments: object) -> ray_fit.Understanding:
        searched.append(arguments)
        return search(*arguments)

    monkeypatch.setattr(ray_fit, "TRIALS", 0)
    monkeypatch.setattr(ray_fit, "_scanned", lambda *_: [])
    monkeypatch.setattr(ray_fit, "_search", counted)
    mapped = map_rays(foreign.problem, replace(foreign, ripple=0.1), tolerance_db=1e-12, most_calls=7)
    assert len(mapped.calls) == 7
    assert len(searched) == 4
    assert mapped.understanding.misfit_db > 0.2


def test_a_distant_call_tests_a_replay_whose_assumptions_are_not_identified(
    foreign: Foreign, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Calls near a minimum do not show whether there is a lower minimum elsewhere."""
    monkeypatch.setattr(ray_fit, "TRIALS", 0)
    monkeypatch.setattr(ray_fit, "_scanned", lambda *_: [])
    rippled = replace(foreign, ripple=0.03)
    mapped = map_rays(foreign.problem, rippled, most_calls=8)
    assert mapped.understanding.misfit_db > 0.2
    assert 0.2 < mapped.distant_gap_db < 1.0
    assert mapped.reached
    assert not mapped.understood
    value = np.array([call.candidate[0] for call in mapped.calls])
    nearest = [np.abs(value[:k] - value[k]).min() for k in range(3, len(value))]
    assert sorted(nearest)[-2] < 0.5  # calls at minima
    assert max(nearest) > 3.0
    text = remark_text(ray_mapping._remark(mapped, foreign.problem))
    assert f"and at a distant call to within {mapped.distant_gap_db:.2f} dB" in text


def test_a_lower_minimum_that_one_search_missed_leads_to_a_further_call(
    foreign: Foreign, mapped: RayMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first search ends at a bound. The second one starts from other points, the third one from what it found."""
    parameters, search = foreign.problem.parameters, ray_mapping.least_squares
    seeds: list[int] = []
    found: list[np.ndarray] = []

    def missing(problem: Problem, starts: int, points: np.ndarray, *, seed: int) -> object:
        seeds.append(seed)
        if len(seeds) == 1:
            return SimpleNamespace(best=Best(parameters.search_bounds[1], np.inf))
        assert len(seeds) < 3 or np.any(np.all(points == found[0], axis=1))
        result = search(problem, starts, points, seed=seed)
        found.append(result.best.x)
        return result

    monkeypatch.setattr(ray_mapping, "least_squares", missing)
    again = map_rays(foreign.problem, foreign)
    assert len(again.calls) == 4
    assert again.reached
    assert again.best.candidate == pytest.approx(mapped.best.candidate, rel=1e-4)
    assert len(set(seeds[:2])) == 2


def test_the_optimum_is_reached_without_understanding(mapped: RayMap) -> None:
    """Misfit and changed paths matter for the replay elsewhere, the gap and the remaining gain for the optimum."""
    assert replace(mapped, gap_db=0.19).reached
    untested = replace(mapped, understanding=replace(mapped.understanding, misfit_db=0.5))
    misfit = replace(untested, distant_gap_db=0.9)
    for foreign in (misfit, replace(mapped, changed_db=0.6)):
        assert foreign.reached
        assert not foreign.understood
    for missed in (
        replace(mapped, gap_db=0.21),
        replace(mapped, remaining_db=0.06),
        replace(mapped, moved_db=0.06),
        replace(mapped, lost=1),
        untested,
        replace(untested, distant_gap_db=1.1),
    ):
        assert not missed.reached
        assert not missed.understood


def losing(foreign: Foreign, link: int, complete: int) -> Callable[[np.ndarray], Export]:
    """The engine without the paths of a link, except in its first `complete` calls."""
    calls = 0

    def ask(candidate: np.ndarray) -> Export:
        nonlocal calls
        calls += 1
        kept = np.flatnonzero((foreign.paths.link != link) | (calls <= complete))
        return Export.of_table(foreign.rays(candidate).take(kept), RaySetting.of(foreign.problem.setup))

    return ask


def test_an_engine_whose_strong_paths_come_and_go_is_not_understood(foreign: Foreign) -> None:
    """It lacks both paths of the first link after its first call."""
    mapped = map_rays(foreign.problem, losing(foreign, link=0, complete=1), most_calls=3)
    assert mapped.understanding.misfit_db < 0.2
    assert mapped.gap_db < 0.05
    assert (mapped.changed, mapped.lost) == (2, 1)
    assert not mapped.reached
    assert not mapped.understood


def test_a_link_that_loses_its_paths_at_the_minimum_ends_the_calls_and_is_named(foreign: Foreign) -> None:
    """The objective is infinite there, so further calls at the minimum would be useless."""
    mapped = map_rays(foreign.problem, losing(foreign, link=1, complete=2))
    assert len(mapped.calls) == 4
    row = foreign.problem.setup.links.row[1]
    text = remark_text(ray_mapping._remark(mapped, foreign.problem))
    assert f"1 link has no path in some of the calls (row {row})" in text
    assert 'set objective.no_path = "censor" and objective.ceiling_db' in text


def test_a_link_that_loses_its_paths_at_a_distant_call_does_not_end_the_calls(
    foreign: Foreign, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The link also loses its paths at the next minimum, but keeps them at the minimum after that."""
    monkeypatch.setattr(ray_fit, "TRIALS", 0)
    monkeypatch.setattr(ray_fit, "_scanned", lambda *_: [])
    rippled, distant, answers = replace(foreign, ripple=0.03), ray_mapping._distant, []
    without: list[int] = []

    def chosen(problem: Problem, calls: list[Call]) -> np.ndarray:
        if not without:
            without.extend([len(calls) + 1, len(calls) + 2])
        return distant(problem, calls)

    def ask(candidate: np.ndarray) -> Export:
        table = rippled.rays(candidate)
        kept = np.flatnonzero((foreign.paths.link != 1) | (len(answers) + 1 not in without))
        answers.append(Export.of_table(table.take(kept), RaySetting.of(foreign.problem.setup)))
        return answers[-1]

    monkeypatch.setattr(ray_mapping, "_distant", chosen)
    monkeypatch.setattr(ray_mapping, "GAP_DB", 10.0)  # every prediction counts as accurate
    monkeypatch.setattr(ray_mapping, "LEFT_DB", -1.0)  # calls do not end because the optimum is reached
    mapped = map_rays(foreign.problem, ask, tolerance_db=10.0, most_calls=6)
    reached = [bool(np.isfinite(answer.path_loss_db[1])) for answer in answers]
    assert [number for number, found in enumerate(reached, 1) if not found] == without
    assert len(mapped.calls) > without[-1]


def test_a_link_that_the_replay_lacks_is_lost(foreign: Foreign, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = ray_fit.Understanding.replay

    def without_the_first_link(self: ray_fit.Understanding, parameters: Parameters, last: Call) -> Replay:
        paths = whole(self, parameters, last).paths
        return Replay(replace(paths, correction=np.where(paths.link == 0, 0.0, paths.correction)), parameters)

    monkeypatch.setattr(ray_fit.Understanding, "replay", without_the_first_link)
    mapped = map_rays(foreign.problem, foreign, most_calls=3)
    assert mapped.gap_db < 0.05
    assert mapped.lost == 1
    assert not mapped.reached


def test_paths_without_a_calibrated_material_do_not_show_that_the_model_represents_the_engine(
    foreign: Foreign,
) -> None:
    """Any model explains ratios that are 1."""
    direct = np.flatnonzero(np.diff(foreign.paths.first) == 0)

    def ask(candidate: np.ndarray) -> Export:
        return Export.of_table(foreign.rays(candidate).take(direct), RaySetting.of(foreign.problem.setup))

    mapped = map_rays(foreign.problem, ask, most_calls=3)
    assert mapped.understanding.misfit_db < 1e-6
    assert mapped.reached
    assert not mapped.understood
    text = remark_text(ray_mapping._remark(mapped, foreign.problem))
    assert text.startswith("No path of the program interacts with a calibrated material")


def test_a_candidate_that_is_asked_twice_is_one_call(foreign: Foreign) -> None:
    """The minimum of the replay may be an earlier call, here the first."""
    measured = foreign(foreign.problem.parameters.start).path_loss_db
    problem = replace(foreign.problem, objective=replace(foreign.problem.objective, measured=measured))
    asked = []

    def export(candidate: np.ndarray) -> Export:
        asked.append(candidate.tobytes())
        return foreign(candidate)

    engine = SimpleNamespace(export=export, hits=0)
    _, trail, _ = ray_mapping.search_rays(problem, engine)  # pyright: ignore[reportArgumentType]
    assert len(asked) > len(set(asked))
    assert trail.rt_calls == len(trail.rmse_db) == len(set(asked))
