"""Rough surfaces: Rayleigh's factor against the mean over random heights, its derivatives, and studies with it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.constants import speed_of_light

import planted
from calibray.calibration.calibrate import calibrate
from calibray.engines import Replay
from calibray.errors import InputError
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind
from calibray.reporting.wording import scene_alone_text
from calibray.study import Setup, Study
from calibray.study.facades import roughness_effects
from link_tables import links_from_frame

ROUGH = "marble.roughness_mm"
PARAMETERS = {name: {"bounds": planted.BOUNDS} for name in planted.TRUTH} | {ROUGH: {"bounds": [0.0, 15.0]}}


@pytest.fixture(scope="module")
def paths():
    return planted.engine().paths


@pytest.fixture(scope="module")
def replay(paths):
    content = planted.content("links.csv", parameters=PARAMETERS, materials={"wood": {"roughness_mm": 4.0}})
    setup = Setup.open(Study.from_content(content), links=links_from_frame(planted.links()))
    return Replay(paths, setup.parameters, effects=setup.effects(paths))


def mean_field(path_length_m: np.ndarray, wavelength: float) -> np.ndarray:
    """Mean of exp(j k d z) over heights z with standard deviation 1, by Gauss-Hermite quadrature."""
    node, weight = np.polynomial.hermite_e.hermegauss(60)
    phase = 2 * np.pi / wavelength * np.multiply.outer(path_length_m, node)
    return (np.exp(1j * phase) @ weight / np.sqrt(2 * np.pi)).real


def test_a_rough_wall_weakens_each_path_by_the_mean_field(paths, replay):
    value = np.append(list(planted.TRUTH.values()), 6.0)
    smooth = Replay(paths, planted.engine().parameters)
    ends = {name: getattr(paths, name)[paths.link] for name in ("tx_position", "rx_position")}
    single = replace(paths, link=np.arange(paths.num_paths), **ends)  # every path is a link of its own
    rough_loss = Replay(single, replay.parameters, effects=replay.effects).path_loss(value[None])[0]
    smooth_loss = Replay(single, smooth.parameters).path_loss(value[None, :3])[0]
    names, factor = list(paths.materials), np.ones(paths.num_paths)
    for path in range(paths.num_paths):
        for hit in range(paths.first[path], paths.first[path + 1]):
            height = {"marble": 6e-3, "wood": 4e-3}.get(names[paths.material[hit]], 0.0)
            if height and paths.kind[hit] == Kind.SPECULAR:
                # A surface that is higher by z makes the path 2 z cos(theta) shorter.
                detour = 2 * height * paths.cos_incidence[hit]
                factor[path] *= mean_field(np.array([detour]), speed_of_light / paths.frequency)[0]
    assert rough_loss - smooth_loss == pytest.approx(-20 * np.log10(factor), abs=1e-9)
    assert (rough_loss - smooth_loss).max() > 1.0


def test_derivatives_agree_with_finite_differences(replay):
    value = np.append(list(planted.TRUTH.values()), 6.0)[None]
    _, jacobian = replay.path_loss_and_jacobian(value)
    for index in range(4):
        step = 1e-5 * np.eye(4)[index]
        above, below = replay.path_loss(np.vstack([value + step, value - step]))
        assert jacobian[0, :, index] == pytest.approx((above - below) / 2e-5, rel=1e-5, abs=1e-6)
    assert np.abs(jacobian[0, :, 3]).max() > 0.1


def test_the_loss_rises_with_the_carrier(paths):
    parameters = Parameters((Parameter(ROUGH, 0.0, 9.0, 1.0),))
    (effect,), (twice,) = (
        roughness_effects({}, parameters, paths.at(factor * paths.frequency)) for factor in (1, 2)
    )
    assert twice.exponent == pytest.approx(4 * effect.exponent)


def test_smooth_surfaces_have_no_effect(paths):
    plain = planted.engine()
    assert roughness_effects({}, plain.parameters, paths) == ()
    assert roughness_effects({"marble": 0.0}, plain.parameters, paths) == ()
    parameters = Parameters((*plain.parameters, Parameter(ROUGH, 0.0, 9.0, 1.0)), plain.parameters.frequency)
    zero = Replay(paths, parameters, effects=roughness_effects({}, parameters, paths))
    value = np.append(plain.parameters.start, 0.0)
    assert zero.path_loss(value[None]) == pytest.approx(plain.path_loss(value[None, :3]), abs=1e-12)


def test_a_planted_roughness_is_found(tmp_path, replay):
    truth = np.append(list(planted.TRUTH.values()), 9.0)
    noise = 0.1 * np.random.default_rng(4).standard_normal(planted.LINKS)
    table = planted.links().assign(path_loss_db=replay.path_loss(truth[None])[0] + noise)
    known = {name: planted.TRUTH[f"{name}.relative_permittivity"] for name in ("concrete", "marble")}
    materials = {name: {"relative_permittivity": value} for name, value in known.items()}
    sections = {
        "parameters": {name: PARAMETERS[name] for name in ("wood.relative_permittivity", ROUGH)},
        "materials": materials | {"wood": {"roughness_mm": 4.0}},
        "method": {"name": "auto", "options": {"starts": 16}},
    }
    result = calibrate(planted.study(tmp_path, table, **sections))
    assert result.parameters[ROUGH] == pytest.approx(9.0, abs=1.0)
    assert result.intervals[ROUGH].contains(9.0)
    assert "the roughness of wood or the roughness of marble" in scene_alone_text(result)


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"parameters": {"wood.roughness_mm": {"bounds": [-1.0, 2.0]}}}, "must be a number in"),
        ({"materials": {"wood": {"roughness_mm": -2.0}}}, "roughness_mm"),
        ({"parameters": PARAMETERS, "engine": {"name": "retrace"}}, "needs engine.name = 'replay'"),
        (
            {"materials": {"wood": {"roughness_mm": 2.0}}, "engine": {"name": "retrace"}},
            "wood.roughness_mm needs",
        ),
        ({"parameters": PARAMETERS, "engine": {"name": "replay", "compress_db": 0.1}}, "compress_db"),
    ],
)
def test_impossible_roughness_is_refused(tmp_path, sections, message):
    with pytest.raises(InputError, match=message):
        planted.study(tmp_path, planted.links(), **sections)


def test_roughness_of_an_unknown_material_is_refused(tmp_path):
    plan = planted.study(tmp_path, planted.links(), parameters={"wod.roughness_mm": {"bounds": [0.0, 2.0]}})
    with pytest.raises(InputError, match="no material 'wod'"):
        Setup.open(plan, links=links_from_frame(planted.links()))
