"""The family of planted problems: drawn from its seed alone, and evaluated as the fields are."""

from dataclasses import replace

import numpy as np
import pytest

import synthetic
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.materials import Material
from calibray.parameters import Parameter, Parameters
from calibray.paths import take
from problem_families.family import LINKS, NOISE_DB, PARAMETERS, problem
from problem_families.numpy_replay import Direct
from problem_families.office import office_site
from problem_families.sites import district_site

MATERIALS = {"walls": Material(4.3, 0.08, 0.18, 0.35), "glass": Material(6.1, 0.02, 0.009, 0.5)}
NAMES = (
    "walls.relative_permittivity",
    "glass.conductivity",
    "walls.scattering_coefficient",
    "glass.thickness",
)


@pytest.fixture(scope="module")
def direct():
    items = zip(NAMES, (1.5, 0.001, 0.1, 0.004), (9.0, 0.2, 0.8, 0.2), strict=True)
    parameters = Parameters(tuple(Parameter(name, low, high, high) for name, low, high in items))
    paths = synthetic.program(synthetic.EVERY_KIND * 3, links=4, ports=(2, 1), materials=MATERIALS)
    return Direct(paths, parameters)


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield problem(2)


def test_path_loss_is_that_of_the_fields(direct):
    candidates = direct.parameters.from_unit(np.random.default_rng(1).random((3, len(NAMES))))
    expected = [
        path_loss(direct.paths, direct.parameters.materials(each, direct.paths.materials))
        for each in candidates
    ]
    assert direct.path_loss(candidates) == pytest.approx(np.array(expected), abs=1e-9)


def test_derivatives_are_differences(direct):
    candidates = direct.parameters.from_unit(np.random.default_rng(2).random((2, len(NAMES))))
    loss, jacobian = direct.path_loss_and_jacobian(candidates)
    assert loss == pytest.approx(direct.path_loss(candidates))
    for column in range(len(NAMES)):
        step = 1e-4 * candidates[:, column, None] * np.eye(len(NAMES))[column]
        slope = (direct.path_loss(candidates + step) - direct.path_loss(candidates - step)) / (
            2.0 * step[:, column, None]
        )
        assert jacobian[:, :, column] == pytest.approx(slope, rel=1e-3, abs=1e-4 * np.abs(slope).max())


def test_a_link_without_a_path_has_no_derivative(direct):
    less = Direct(take(direct.paths, np.flatnonzero(direct.paths.link != 1)), direct.parameters)
    loss, jacobian = less.path_loss_and_jacobian(direct.parameters.start[None])
    assert np.isinf(loss[0]).tolist() == [False, True, False, False]
    assert (jacobian[0, 1] == 0.0).all()
    assert np.isfinite(jacobian).all()


@pytest.mark.parametrize("make", [district_site, office_site])
def test_a_site_is_its_seeds_alone_and_its_links_have_two_ends(make, tmp_path):
    first, again, other = (make(np.random.default_rng(seed), 30) for seed in (1, 1, 2))
    written = [site.write(tmp_path / str(place)) for place, site in enumerate((first, again, other))]
    meshes = [
        {file.name: file.read_bytes() for file in sorted((path.parent / "meshes").iterdir())}
        for path in written
    ]
    assert meshes[0] == meshes[1] != meshes[2]
    assert np.array_equal(first.rx, again.rx)
    assert (np.linalg.norm(first.tx - first.rx, axis=1) > 0.01).all()
    text = written[0].read_text()
    assert all(f"mat-{name}" in text for name in first.stuffs)


def test_a_problem_is_as_drawn_and_its_truth_near_the_optimum(planted):
    again = problem(2)
    assert planted.fingerprint == again.fingerprint
    assert PARAMETERS[0] <= len(planted.truth) <= PARAMETERS[1]
    assert LINKS[0] <= len(planted.measured) <= LINKS[1]
    assert NOISE_DB[0] <= planted.noise_db <= NOISE_DB[1]
    assert ((planted.parameters.lower <= planted.truth) & (planted.truth <= planted.parameters.upper)).all()
    at_truth = float(planted.told(planted.parameters.to_search(planted.truth)[None]).value[0])
    assert planted.minimum_rmse_db <= at_truth < 1.3 * planted.noise_db
    assert planted.minimum_rmse_db == planted.minimum_rmse_db  # the second comes from the disk


def test_the_cheap_model_is_another_than_the_engine(planted):
    cheap, rich = (model.path_loss(planted.truth[None])[0] for model in (planted.cheap, planted.engine))
    assert np.isfinite(rich).all()
    reached = np.isfinite(cheap)
    assert reached.mean() > 0.7
    assert np.abs(cheap - rich)[reached].max() > 0.1
    with pytest.raises(AssertionError):  # a cheap model that is the engine would be found
        assert np.abs(rich - rich).max() > 0.1


def test_offsets_shift_no_residual(planted):
    free = replace(planted, offsets=True, station=np.arange(len(planted.measured)) % 3)
    loss = free.evaluate(free.truth[None])
    shifted = loss + np.array([0.0, 2.0, -5.0])[free.station]
    assert free.residuals(shifted) == pytest.approx(free.residuals(loss), abs=1e-9)
    assert planted.residuals(shifted) != pytest.approx(planted.residuals(loss), abs=1e-9)


def test_derivatives_are_those_of_the_search_space(planted):
    middle = 0.5 * (planted.lower + planted.upper)[None]
    jacobian = planted.told(middle, derivatives=True).jacobian
    for column in range(len(planted.truth)):
        step = 1e-4 * np.eye(len(planted.truth))[column] * (planted.upper - planted.lower)
        ends = [planted.told(middle + sign * step).residuals[0] for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2.0 * step[column])
        assert jacobian[0, :, column] == pytest.approx(slope, rel=1e-2, abs=1e-3 * np.abs(slope).max() + 1e-6)


@pytest.mark.parametrize(("seed", "kind"), [(0, "village"), (-1, "office")])
def test_what_is_no_family_is_refused(seed, kind):
    with pytest.raises(InputError):
        problem(seed, kind)
