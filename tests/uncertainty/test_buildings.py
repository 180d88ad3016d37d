"""Buildings of a scene, their replay, and their effect on intervals."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from scipy.stats import halfnorm

import planted
from calibray import calibrate, engines, fields
from calibray.engines import ChunkedReplay, InProcess, Replay, ReplayCarriers
from calibray.engines.cluster.chunks import cut
from calibray.engines.kinds.replay import replay, trace_and_replay
from calibray.engines.replay import CarrierPaths
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.materials import Material
from calibray.measurements.observables import Statistic
from calibray.optimizers import LeastSquares
from calibray.parameters import Parameter, Parameters
from calibray.paths import Paths
from calibray.paths.program import take, take_links
from calibray.result.verdict import Cause
from calibray.scenes import Triangles, building_numbers
from calibray.study import Setup, Study
from calibray.uncertainty import buildings
from calibray.uncertainty.assessment import certainty
from calibray.uncertainty.buildings import split_replay
from calibray.uncertainty.joint_model import joint_model
from link_tables import links_from_frame

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
CORNERS = np.array([[0, 1, 2], [0, 2, 3]])


def upright(low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
    """The four walls of a box, 10 m high [8, 3, 3]."""
    plan = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    walls = []
    for start, end in zip(plan, np.roll(plan, -1, axis=0), strict=True):
        foot, top = np.array([*start, 0.0]), np.array([*end, 10.0])
        walls += [[foot, [*end, 0.0], top], [foot, top, [*start, 10.0]]]
    return np.array(walls)


def scene(*boxes: np.ndarray) -> Triangles:
    """The boxes as one mesh over a ground that reaches under all of them."""
    ground = (SQUARE * [400, 400, 0] - [200, 200, 0])[CORNERS]
    corners = np.concatenate([ground, *boxes])
    flat = np.arange(len(corners)) < len(ground)
    face = np.arange(3 * len(corners)).reshape(-1, 3)
    return Triangles(corners.reshape(-1, 3), face, np.zeros(len(corners), dtype=int), flat)


def test_streets_separate_buildings_and_touching_objects_are_one():
    found = scene(upright((0, 0), (20, 10)), upright((20.0, 0), (40, 10)), upright((45, 0), (60, 10)))
    first, second, beside, inside = building_numbers(
        found, np.array([[0.0, 5.0, 3.0], [40.0, 5.0, 3.0], [45.0, 5.0, 3.0], [52.0, 5.0, 10.0]])
    )
    assert first == second
    assert beside == inside  # on the roof, away from every edge
    assert first != beside


def test_a_scene_with_only_ground_has_no_buildings():
    assert building_numbers(scene(), np.zeros((2, 3))).tolist() == [-1, -1]


@pytest.fixture(scope="module")
def problem() -> Problem:
    study = Study.from_content(planted.content("links.csv", noise=None))
    return Problem.of(Setup.open(study, links=links_from_frame(planted.links())), planted.engine())


def test_factors_act_on_one_building_and_further_constants_on_all(problem):
    """A factor on all buildings of a material acts like one on the material; the ground is no building."""
    study = problem.parameters
    thickness = Parameter("marble.thickness", 0.05, 1.0, 0.2, "log")
    both = replace(study, items=(*study.items, thickness))
    replay = split_replay(problem, both, by_building=True)
    values = np.array([list(planted.TRUTH.values()), [5.0, 4.0, 3.0]])
    traced = problem.engine.paths.materials["marble"].thickness
    every = np.hstack([values, [[traced], [traced]]])
    equal = np.ones((2, len(replay.parameter_of)))
    assert replay.path_loss(every, equal) == pytest.approx(problem.engine.path_loss(values), abs=1e-9)
    factor = np.where(replay.parameter_of == 1, 1.1, equal)
    scaled = problem.engine.path_loss(values * [1.0, 1.1, 1.0])
    assert replay.path_loss(every, factor) == pytest.approx(scaled, abs=1e-9)
    # Concrete is the ground here, which is one and does not differ from itself.
    assert set(replay.building_of[replay.parameter_of == 0]) == {-1}
    assert (replay.building_of[replay.parameter_of > 0] >= 0).all()
    # The thickness of marble acts as in the materials of the paths.
    paths = problem.engine.paths
    materials = study.materials(values[0], paths.materials)
    materials["marble"] = replace(materials["marble"], thickness=0.3)
    thicker = fields.path_loss(paths, materials)
    assert replay.path_loss(every * [1, 1, 1, 0.3 / traced], equal)[0] == pytest.approx(thicker, abs=1e-6)
    assert np.abs(thicker - problem.engine.path_loss(values)[0]).max() > 0.1
    alike = split_replay(problem, both, by_building=False)
    assert set(alike.building_of) == {-1}
    assert len(alike.parameter_of) == 4


def _assessed(problem, noise_db=0.5, **noise):
    """A planted campaign with Gaussian noise, and what the study says of it."""
    study = Study.from_content(
        planted.content("links.csv", noise={"kind": "gaussian", "range_m": 0, **noise})
    )
    measured = planted.campaign(noise_db=noise_db).path_loss_db.to_numpy()
    setup = Setup.open(study, links=links_from_frame(planted.links()))
    here = Problem.of(setup, planted.engine())
    here = replace(here, objective=replace(here.objective, measured=measured))
    return certainty(here, search(here, LeastSquares(*here.parameters.search_bounds, starts=16)))


def _deviation(draws):
    """Standard deviation of the parameters' logarithms [d]."""
    value = np.log(draws.point)
    return np.sqrt(draws.weight @ (value - draws.weight @ value) ** 2)


def test_intervals_cover_the_mean_over_buildings(problem):
    """Marble is on one building, which may differ from others; the ground does not differ."""
    equal = _assessed(problem, 0.1, heterogeneity=0, constants_spread=0).posterior
    differing = _assessed(problem, 0.1, heterogeneity=0.15, constants_spread=0).posterior
    np.testing.assert_allclose(equal.means.point, equal.seen.point, rtol=1e-12)
    alone = np.hypot(_deviation(differing.seen)[1], 0.15)
    # If path loss were linear in the constants it would be this.
    assert 0.75 < _deviation(differing.means)[1] / alone < 1.4
    assert _deviation(differing.seen)[1] < 0.85 * alone
    assert _deviation(equal.means)[1] < 0.75 * alone


def test_a_thickness_that_is_not_known_exactly_widens_the_interval(problem):
    exact = _assessed(problem, 0.05, heterogeneity=0, constants_spread=0)
    uncertain = _assessed(problem, 0.05, heterogeneity=0, constants_spread=0.3)
    ratio = _deviation(uncertain.posterior.means) / _deviation(exact.posterior.means)
    assert ratio.max() > 1.3
    assert ratio.min() > 0.8
    assert uncertain.posterior.joint.shape[1] > exact.posterior.joint.shape[1] == 3
    # The result states an upper bound of the width that exact constants would leave.
    widest = int(np.argmax(ratio))
    without = list(uncertain.record.intervals.values())[widest].without
    assert 1.0 / ratio[widest] < without[Cause.CONSTANTS] < 0.85
    assert all(Cause.CONSTANTS not in interval.without for interval in exact.record.intervals.values())


SCATTER = "marble.scattering_coefficient"


def test_a_scattering_coefficient_of_0_is_exact_with_a_probability_of_one_half(problem):
    best = problem.parameters.to_search(np.array(list(planted.TRUTH.values())))
    problem = _measuring(problem, problem.modelled(best[None])[0])
    model = joint_model(problem, best, 0.3**2, problem.freedom)
    index = model.parameters.names.index(SCATTER)
    drawn = model.parameters.from_unit(model.draw_prior(20_000, np.random.default_rng(3)))[:, index]
    assert np.mean(drawn == 0.0) == pytest.approx(0.5, abs=0.015)
    assert drawn.min() == 0.0
    # The positive half of a Gaussian with a standard deviation of 0.25, up to three of them.
    half = halfnorm(scale=0.25)
    levels = half.cdf([0.1, 0.25, 0.5]) / half.cdf(0.75)
    assert [np.mean(drawn[drawn > 0] < each) for each in (0.1, 0.25, 0.5)] == pytest.approx(levels, abs=0.015)
    # What it changes: it weakens reflections by the factor 1 - S^2, and those of marble are a part of the power.
    assert 0 < model.effects_db[SCATTER] < -10 * np.log10(1 - 0.25**2) + 1e-6
    # A study that states 0 is believed.
    materials = {"marble": {"scattering_coefficient": 0.0}, "wood": {"conductivity": 0.01}}
    smooth = planted.content("links.csv", noise=None, materials=materials)
    stated = replace(problem, setup=replace(problem.setup, study=Study.from_content(smooth)))
    exact = joint_model(stated, best, 0.3**2, problem.freedom)
    assert {*model.parameters.names} - {*exact.parameters.names} == {SCATTER}


def test_walls_that_scatter_have_no_gaps_at_the_truth(problem):
    """Without a scattering coefficient, no permittivities are free of gaps."""
    study = problem.parameters
    best = study.to_search(np.array(list(planted.TRUTH.values())))
    every = replace(study, items=(*study.items, Parameter(SCATTER, 0.0, 0.9, 0.0)))
    truth = np.array([[*planted.TRUTH.values(), 0.4]])
    replay = split_replay(problem, every, by_building=False)
    here = _measuring(problem, replay.path_loss(truth, np.ones((1, len(every))))[0])
    trail = search(here, LeastSquares(*study.search_bounds, starts=16))
    assert trail.best_value > 0.05
    model = joint_model(here, best, 0.3**2, here.freedom)
    start = dict(zip(model.parameters.names, model.parameters.start, strict=True))
    value = np.array([[*(start | planted.TRUTH | {SCATTER: 0.4}).values()]])
    none = np.zeros((1, len(model.parameter_of)))
    assert model.gaps(model.parameters.to_unit(value), none) == pytest.approx(0.0, abs=1e-6)
    assert np.abs(model.gaps(model.parameters.to_unit(value * (value != 0.4)), none)).max() > 0.05


def _measuring(problem: Problem, measured_db: np.ndarray) -> Problem:
    return replace(problem, objective=replace(problem.objective, measured=measured_db))


def at_carriers(problem: Problem) -> Problem:
    """The problem with every second link at another carrier, where marble has another conductivity."""
    paths, links = problem.engine.paths, np.arange(planted.LINKS)
    marble = {"marble": replace(paths.materials["marble"], conductivity=0.3)}
    there = CarrierPaths(take_links(paths, links[1::2]).at(10e9, marble), links[1::2])
    here = CarrierPaths(take_links(paths, links[::2]), links[::2])
    return replace(problem, engine=ReplayCarriers([here, there], problem.parameters, paths.materials))


def test_constants_that_are_equal_at_all_carriers_vary(problem):
    best = problem.parameters.to_search(np.array(list(planted.TRUTH.values())))
    objective = replace(problem.objective, measured=problem.modelled(best[None])[0])
    problem = replace(problem, objective=objective)
    several = at_carriers(problem)
    one, both = (joint_model(each, best, 0.3**2, problem.freedom) for each in (problem, several))
    assert "marble.thickness" in both.effects_db
    assert {*one.effects_db} - {*both.effects_db} == {"marble.conductivity"}


@pytest.mark.parametrize("carriers", [1, 2])
def test_logarithms_of_factors_act_on_the_gaps(problem, carriers):
    """A factor on all buildings of a material is a factor on its mean; without factors the gaps are the study's."""
    problem = problem if carriers == 1 else at_carriers(problem)
    best = problem.parameters.to_search(np.array(list(planted.TRUTH.values())))
    measured = problem.modelled(best[None])[0]
    known = replace(problem, objective=replace(problem.objective, measured=measured))
    model = joint_model(known, best, 0.3**2, problem.freedom)
    value = np.append(list(planted.TRUTH.values()), [item.start for item in model.parameters.items[3:]])
    none = np.zeros((1, len(model.parameter_of)))
    assert set(model.only_buildings.tolist()) == set(model.parameter_of.tolist()) == {1, 2}
    for index in (1, 2):
        scaled = value * np.where(np.arange(len(value)) == index, 1.1, 1.0)
        logarithms = np.log(1.1) * (model.parameter_of == index)[None]
        by_factor = model.gaps(model.parameters.to_unit(value)[None], logarithms)
        assert by_factor == pytest.approx(model.gaps(model.parameters.to_unit(scaled)[None], none), abs=1e-9)
        assert np.abs(by_factor - model.gaps(model.parameters.to_unit(value)[None], none)).max() > 0.1


def test_constants_without_effect_stay_fixed(problem, monkeypatch):
    best = problem.parameters.to_search(np.array(list(planted.TRUTH.values())))
    study = Study.from_content(planted.content("links.csv", noise={"constants_spread": 0.3}))
    measured = problem.modelled(best[None])[0]
    objective = replace(problem.objective, measured=measured)
    problem = replace(problem, setup=replace(problem.setup, study=study), objective=objective)
    every = joint_model(problem, best, 0.3**2, problem.freedom)
    middle = float(np.median(list(every.effects_db.values())))
    monkeypatch.setattr("calibray.uncertainty.joint_model.NO_EFFECT", middle / every.marginal.noise_db)
    model = joint_model(problem, best, 0.3**2, problem.freedom)
    assert len(problem.parameters) < len(model.parameters) < len(every.parameters)
    assert len(model.priors) == len(model.parameters) - len(problem.parameters)
    assert model.draw_prior(3, np.random.default_rng(1)).shape == (3, len(model.parameters))


def test_weak_paths_are_left_out_of_large_programs(problem, monkeypatch):
    values = problem.parameters.from_unit(np.random.default_rng(6).random((20, 3)))
    whole = problem.engine.path_loss(values)
    monkeypatch.setattr(buildings, "MANY", 0)
    monkeypatch.setattr(buildings, "WEAK", 0.8)
    replay = split_replay(problem, problem.parameters, by_building=True)
    assert 0 < replay.interactions < problem.engine.interactions
    fewer = replay.path_loss(values, np.ones((20, len(replay.parameter_of))))
    # At one of 16 candidates the paths left out carry a twentieth on average.
    assert 0.0 < np.mean(fewer - whole) < 0.3
    assert (fewer - whole).min() > -1e-9
    assert (fewer - whole).max() < 3.0


def test_errors_out_of_sight_are_tried_unless_errors_are_declared_independent(problem):
    best = problem.parameters.to_search(np.array(list(planted.TRUTH.values())))

    def kinds(**noise):
        study = Study.from_content(planted.content("links.csv", noise=noise))
        setup = Setup.open(study, links=links_from_frame(planted.links()))
        model = joint_model(Problem.of(setup, problem.engine), best, 0.3**2, problem.freedom)
        return {each.kind for each in model.marginal.models}

    assert kinds(heterogeneity=0, constants_spread=0) == {
        "gaussian",
        "correlated",
        "out_of_sight",
        "student-t",
    }
    assert kinds(heterogeneity=0, constants_spread=0, range_m=0) == {"gaussian", "student-t"}


# Coefficients of laws


LAW = (Parameter("marble.itu_a", 1.5, 12.0, 8.0), Parameter("marble.itu_b", -0.5, 0.5, 0.1))
"""Both coefficients; in the opposite order, the exponent comes first."""


def with_law(problem: Problem, *items: Parameter) -> Problem:
    """The problem at two carriers, with coefficients of the law of marble as parameters."""
    paths, links = problem.engine.paths, np.arange(planted.LINKS)
    carriers = [
        CarrierPaths(take_links(paths, chosen).at(frequency), chosen)
        for chosen, frequency in ((links[::2], 3.5e9), (links[1::2], 10e9))
    ]
    engine = ReplayCarriers(carriers, Parameters(items, 3.5e9), paths.materials)
    return replace(problem, engine=engine)


@pytest.mark.parametrize("items", [LAW, LAW[::-1]])
def test_buildings_scale_a_law_and_constants_vary_beside_it(problem, items):
    known = with_law(problem, *items)
    scale = known.parameters.names.index("marble.itu_a")
    thickness = Parameter("marble.thickness", 0.05, 1.0, 0.2, "log")
    split = split_replay(known, replace(known.parameters, items=(*items, thickness)), by_building=True)
    traced = problem.engine.paths.materials["marble"].thickness
    value = np.append([item.start for item in items], traced)[None]
    equal = np.ones((1, len(split.parameter_of)))
    assert split.path_loss(value, equal) == pytest.approx(known.engine.path_loss(value[:, :2]), abs=1e-9)
    scaled = value * np.where(np.arange(3) == scale, 1.1, 1.0)
    factors = np.where(split.parameter_of == scale, 1.1, equal)
    expected = known.engine.path_loss(scaled[:, :2])
    assert split.path_loss(value, factors) == pytest.approx(expected, abs=1e-9)
    assert set(split.parameter_of.tolist()) == {scale, 2}
    assert (split.building_of >= 0).all()
    thicker = split.path_loss(value * [1, 1, 0.3 / traced], equal)
    assert np.abs(thicker - split.path_loss(value, equal)).max() > 0.1


def test_buildings_are_equal_if_only_the_exponent_of_a_law_is_a_parameter(problem):
    known = with_law(problem, LAW[1], Parameter("wood.relative_permittivity", 1.5, 12.0, 2.6))
    split = split_replay(known, known.parameters, by_building=True)
    assert set(split.building_of[split.parameter_of == 0].tolist()) == {-1}
    value = known.parameters.start[None]
    equal = np.ones((1, len(split.parameter_of)))
    assert split.path_loss(value, equal) == pytest.approx(known.engine.path_loss(value), abs=1e-9)


def test_constants_vary_beside_laws(problem):
    known = with_law(problem, *LAW)
    best = known.parameters.to_search(known.parameters.start)
    measured = known.modelled(best[None])[0]
    known = replace(known, objective=replace(known.objective, measured=measured))
    model = joint_model(known, best, 0.3**2, known.freedom)
    assert "marble.thickness" in model.effects_db
    assert set(model.parameter_of.tolist()) == set(model.only_buildings.tolist()) == {0}


# Links in chunks


def in_chunks(setup: Setup, size: int, at_most: int | None = None) -> ChunkedReplay:
    """The replay of a study in chunks, in this process."""
    chunks = cut(setup.links, size)
    return ChunkedReplay(InProcess(at_most), setup, chunks, partial(trace_and_replay, None))


def test_chunks_split_as_all_links_do():
    """Also chunks of one link, of which a blocked one has no path."""
    chosen = np.array([1, planted.INSIDE, 10])
    study = Study.from_content(planted.content("links.csv", noise=None))
    setup = Setup.open(study, links=links_from_frame(planted.links(blocked=True).iloc[chosen]))
    engine = planted.engine(blocked=True)
    paths = take_links(engine.paths, chosen)
    assert set(paths.link.tolist()) == {0, 2}
    whole = Problem.of(setup, Replay(paths, engine.parameters))
    chunked = replace(whole, engine=in_chunks(setup, 1))
    thickness = Parameter("marble.thickness", 0.05, 1.0, 0.2, "log")
    both = replace(whole.parameters, items=(*whole.parameters.items, thickness))
    for by_building in (False, True):
        one, many = (split_replay(each, both, by_building=by_building) for each in (whole, chunked))
        assert many.parameter_of.tolist() == one.parameter_of.tolist()
        assert many.building_of.tolist() == one.building_of.tolist()
        assert many.interactions == one.interactions
        random = np.random.default_rng(3)
        values, factors = both.from_unit(random.random((7, 4))), random.uniform(0.8, 1.2, (7, len(one.keys)))
        assert many.path_loss(values, factors) == pytest.approx(one.path_loss(values, factors), abs=1e-9)
    assert len(set(one.building_of.tolist())) > 2
    answers = (each.respond(values, factors, (Statistic("rms_delay_spread"),)) for each in (one, many))
    expected, found = answers
    assert found.path_loss == pytest.approx(expected.path_loss, abs=1e-9)
    assert found.observed == pytest.approx(expected.observed, rel=1e-9, nan_ok=True)


def without_ground_in_the_west(paths: Paths, rx: np.ndarray) -> Paths:
    """Without the paths to receivers at x < 0 that meet concrete."""
    path = np.repeat(np.arange(paths.num_paths), np.diff(paths.first))
    met = np.unique(path[paths.material == list(paths.materials).index("concrete")])
    return take(paths, np.setdiff1d(np.arange(paths.num_paths), met[rx[paths.link[met], 0] < 0]))


def test_chunks_may_lack_constants_of_others(problem):
    """Paths in the west do not meet concrete, whose constants come first: the other constants keep their factors."""
    setup = problem.setup

    def opening(study: Setup, materials: Mapping[str, Material]) -> Replay | ReplayCarriers:
        return replay(study, without_ground_in_the_west(study.trace(materials), study.links.rx))

    paths = without_ground_in_the_west(problem.engine.paths, setup.links.rx)
    chunked = ChunkedReplay(InProcess(), setup, cut(setup.links, planted.LINKS // 2), opening)
    one, many = (
        split_replay(replace(problem, engine=engine), problem.parameters, by_building=True)
        for engine in (replay(setup, paths), chunked)
    )
    assert many.keys.tolist() == one.keys.tolist()
    random = np.random.default_rng(3)
    values = problem.parameters.from_unit(random.random((7, len(problem.parameters))))
    factors = random.uniform(0.8, 1.2, (7, len(one.keys)))
    assert many.path_loss(values, factors) == pytest.approx(one.path_loss(values, factors), abs=1e-9)


def paths_held() -> int:
    """Number of paths in all replays of this process."""
    return sum(each.paths.num_paths for each in gc.get_objects() if isinstance(each, Replay))


def test_a_process_holds_no_more_split_paths_than_chunks_have_room(problem):
    before = paths_held()
    chunked = replace(problem, engine=in_chunks(problem.setup, 3, at_most=1))
    split = split_replay(chunked, problem.parameters, by_building=True)
    values = problem.parameters.start[None]
    for _ in range(2):
        split.path_loss(values, np.ones((1, len(split.keys))))
    links = problem.engine.paths.link
    largest = max(int(np.isin(links, chunk).sum()) for chunk in chunked.engine.chunks)
    # The kept chunk and its split; with room for all of them, twice the paths.
    assert 0 < paths_held() - before <= 2 * largest < problem.engine.paths.num_paths
    roomy = replace(problem, engine=in_chunks(problem.setup, 3))
    split_replay(roomy, problem.parameters, by_building=True)
    assert paths_held() - before > 2 * problem.engine.paths.num_paths


def thicker_wood() -> pd.DataFrame:
    """The planted campaign with wood 1.3 times as thick as the scene states."""
    paths = planted.engine().paths
    materials = planted.engine().parameters.materials(list(planted.TRUTH.values()), paths.materials)
    wood = materials["wood"]
    loss = fields.path_loss(paths, {**materials, "wood": replace(wood, thickness=1.3 * wood.thickness)})
    noise = 0.1 * np.random.default_rng(3).standard_normal(planted.LINKS)
    return planted.links().assign(path_loss_db=loss + noise)


@pytest.mark.usefixtures("few_draws")
def test_draws_of_chunks_are_those_of_all_links_even_if_a_worker_dies(tmp_path, monkeypatch):
    """Constants and buildings vary in chunks as well, so that the interval covers the truth if a thickness is wrong."""
    monkeypatch.setenv("CALIBRAY_CACHE", str(tmp_path / "cache"))
    killed: list[int] = []

    def kill_one(stage: str, done: int, total: int | None) -> None:
        if stage == "drawing" and done > 10 and not killed:
            killed.append(multiprocessing.active_children()[0].pid or 0)
            os.kill(killed[0], signal.SIGKILL)

    def calibrated(engine=None, **arguments):
        study = planted.study(
            tmp_path,
            thicker_wood(),
            noise={"kind": "gaussian", "range_m": 0, "constants_spread": 0.3},
            method={"name": "least-squares", "options": {"starts": 4}},
            engine={"name": "replay", **(engine or {})},
        )
        return calibrate(study, **arguments)

    whole = calibrated()
    with engines.open_workers(1) as workers:
        found = calibrated({"chunk_links": 6}, workers=workers, progress=kill_one)
    assert killed
    assert "wood.thickness" in whole.uncertainty.constants_db
    assert found.uncertainty.constants_db == pytest.approx(whole.uncertainty.constants_db, rel=1e-6)
    for name, draws in whole.uncertainty.draws.items():
        assert found.uncertainty.draws[name] == pytest.approx(draws, rel=1e-6)
    for name, interval in whole.intervals.items():
        ends = found.intervals[name].lower, found.intervals[name].upper
        assert ends == pytest.approx((interval.lower, interval.upper), rel=1e-6)
        assert found.intervals[name].verdict == interval.verdict
        assert found.intervals[name].contains(planted.TRUTH[name])
