"""Planted problems: determined by their seed, and evaluated like `calibray.fields`."""

from dataclasses import replace

import numpy as np
import pytest

import synthetic
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.materials import Material
from calibray.parameters import Parameter, Parameters
from calibray.paths import take
from problem_families import family, problems
from problem_families.family import LINKS, NOISE_DB, PARAMETERS, PlantedProblem, problem
from problem_families.numpy_replay import NumpyReplay
from problem_families.sites import district_site, office_site

MATERIALS = {"walls": Material(4.3, 0.08, 0.18, 0.35), "glass": Material(6.1, 0.02, 0.009, 0.5)}
NAMES = (
    "walls.relative_permittivity",
    "glass.conductivity",
    "walls.scattering_coefficient",
    "glass.thickness",
)


@pytest.fixture(scope="module")
def replay():
    items = zip(NAMES, (1.5, 0.001, 0.1, 0.004), (9.0, 0.2, 0.8, 0.2), strict=True)
    parameters = Parameters(tuple(Parameter(name, low, high, high) for name, low, high in items))
    paths = synthetic.program(synthetic.EVERY_KIND * 3, links=4, ports=(2, 1), materials=MATERIALS)
    return NumpyReplay(paths, parameters)


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(family, "SAMPLES", 10_000)
        patch.setattr(family, "STARTS", 8)
        patch.setenv("CALIBRAY_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield problem(2)


def test_path_loss_equals_the_fields(replay):
    candidates = replay.parameters.from_unit(np.random.default_rng(1).random((3, len(NAMES))))
    expected = [
        path_loss(replay.paths, replay.parameters.materials(candidate, replay.paths.materials))
        for candidate in candidates
    ]
    assert replay.path_loss(candidates) == pytest.approx(np.array(expected), abs=1e-9)


def test_derivatives_equal_finite_differences(replay):
    candidates = replay.parameters.from_unit(np.random.default_rng(2).random((2, len(NAMES))))
    loss, jacobian = replay.path_loss_and_jacobian(candidates)
    assert loss == pytest.approx(replay.path_loss(candidates))
    for column in range(len(NAMES)):
        step = 1e-4 * candidates[:, column, None] * np.eye(len(NAMES))[column]
        slope = (replay.path_loss(candidates + step) - replay.path_loss(candidates - step)) / (
            2.0 * step[:, column, None]
        )
        assert jacobian[:, :, column] == pytest.approx(slope, rel=1e-3, abs=1e-4 * np.abs(slope).max())


def test_a_link_without_a_path_has_no_derivative(replay):
    less = NumpyReplay(take(replay.paths, np.flatnonzero(replay.paths.link != 1)), replay.parameters)
    loss, jacobian = less.path_loss_and_jacobian(replay.parameters.start[None])
    assert np.isinf(loss[0]).tolist() == [False, True, False, False]
    assert (jacobian[0, 1] == 0.0).all()
    assert np.isfinite(jacobian).all()


@pytest.mark.parametrize("make", [district_site, office_site])
def test_a_site_is_determined_by_its_seed_and_its_links_have_two_ends(make, tmp_path):
    first, again, other = (make(np.random.default_rng(seed), 30) for seed in (1, 1, 2))
    written = [site.write(tmp_path / str(index)) for index, site in enumerate((first, again, other))]
    meshes = [
        {file.name: file.read_bytes() for file in sorted((path.parent / "meshes").iterdir())}
        for path in written
    ]
    assert meshes[0] == meshes[1] != meshes[2]
    assert np.array_equal(first.rx, again.rx)
    assert (np.linalg.norm(first.tx - first.rx, axis=1) > 0.01).all()
    text = written[0].read_text()
    assert all(f"mat-{name}" in text for name in first.materials)


def test_a_problem_keeps_to_its_ranges_and_its_truth_is_near_the_optimum(planted):
    again = problem(2)
    assert planted.fingerprint == again.fingerprint
    assert PARAMETERS[0] <= len(planted.truth) <= PARAMETERS[1]
    assert LINKS[0] <= len(planted.measured) <= LINKS[1]
    assert NOISE_DB[0] <= planted.noise_db <= NOISE_DB[1]
    assert ((planted.parameters.lower <= planted.truth) & (planted.truth <= planted.parameters.upper)).all()
    at_truth = float(planted.evaluate(planted.parameters.to_search(planted.truth)[None]).value[0])
    assert planted.minimum_rmse_db <= at_truth < 1.3 * planted.noise_db
    assert planted.minimum_rmse_db == planted.minimum_rmse_db  # the second one is read from disk


def test_the_cheap_model_differs_from_the_engine(planted):
    cheap, engine = (model.path_loss(planted.truth[None])[0] for model in (planted.cheap, planted.engine))
    assert np.isfinite(engine).all()
    reached = np.isfinite(cheap)
    assert reached.mean() > 0.7
    assert np.abs(cheap - engine)[reached].max() > 0.1


def test_runs_with_another_cheap_model_are_other_runs(planted, monkeypatch):
    def fingerprint(problem: PlantedProblem) -> str:
        monkeypatch.setattr(problems, "problem", lambda seed, kind: problem)
        return problems.planted_problem("district", 2).fingerprint

    other = NumpyReplay(planted.engine.paths, planted.parameters)
    assert fingerprint(planted) == fingerprint(planted) != fingerprint(replace(planted, cheap=other))


def test_residuals_do_not_depend_on_offsets(planted):
    free = replace(planted, offsets=True, station=np.arange(len(planted.measured)) % 3)
    loss = free.engine.path_loss(free.truth[None])
    shifted = loss + np.array([0.0, 2.0, -5.0])[free.station]
    assert free.residuals(shifted) == pytest.approx(free.residuals(loss), abs=1e-9)
    assert planted.residuals(shifted) != pytest.approx(planted.residuals(loss), abs=1e-9)


def test_derivatives_are_by_search_coordinates(planted):
    middle = 0.5 * (planted.lower + planted.upper)[None]
    jacobian = planted.evaluate(middle, derivatives=True).jacobian
    for column in range(len(planted.truth)):
        step = 1e-4 * np.eye(len(planted.truth))[column] * (planted.upper - planted.lower)
        ends = [planted.evaluate(middle + sign * step).residuals[0] for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2.0 * step[column])
        assert jacobian[0, :, column] == pytest.approx(slope, rel=1e-2, abs=1e-3 * np.abs(slope).max() + 1e-6)


@pytest.mark.parametrize(("seed", "kind"), [(0, "village"), (-1, "office")])
def test_unknown_families_and_seeds_are_refused(seed, kind):
    with pytest.raises(InputError):
        problem(seed, kind)
