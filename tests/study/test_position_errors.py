"""Errors of positions: the mean power of displaced receivers, and the noise that their spread adds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import calibray as cb
import two_ray
from calibray import engines
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.measurements import Measurements
from calibray.study import Setup, Study
from small_scenes import write_scene
from two_ray import TwoRay

ERROR_M = 4.0


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return two_ray.study(tmp_path_factory.mktemp("exact"), objective={"combining": "power"})


def with_error(exact: Study, **links: object) -> Study:
    content = exact.content()
    content["links"] |= {"position_error_m": ERROR_M} | links
    content["noise"]["std_db"] = 2.0
    return Study.from_content(content, exact.path)


def test_power_is_the_mean_over_displaced_receivers(exact: Study) -> None:
    setup = Setup.open(with_error(exact), tracer=TwoRay)
    links = setup.links
    powers, losses = [], []
    for angle in np.radians([0.0, 90.0, 180.0, 270.0]):
        rx = links.rx + np.sqrt(2) * ERROR_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        moved = Measurements(tx=links.tx, rx=rx, path_loss_db=np.zeros(len(links)))
        loss = path_loss(Setup.open(exact, tracer=TwoRay, links=moved).trace())
        powers.append(10 ** (-loss / 10))
        losses.append(loss)
    expected = -10 * np.log10(np.mean(powers, axis=0))
    np.testing.assert_allclose(path_loss(setup.trace()), expected, atol=1e-9)
    weight = setup.with_position_noise().links.weight
    np.testing.assert_allclose(1 / weight, 2.0**2 + np.std(losses, axis=0) ** 2, rtol=1e-9)
    # Near the transmitter, four metres matter.
    assert weight[0] < weight[-1] / 1.5


def sloping(exact: Study, folder: Path, **links: object) -> Study:
    """The study with heights above ground that rises by 20 % to the east."""
    plane = [
        [(x, y, 0.2 * x) for x, y in [(-300.0, -300.0), (300.0, -300.0), (300.0, 300.0), (-300.0, 300.0)]]
    ]
    write_scene(folder / "slope", {"ground": plane}, two_ray.GROUND, "mat-ground")
    content = with_error(exact, heights="ground", file=str(exact.links_path), **links).content()
    content["scene"]["file"] = "slope/scene.xml"
    return Study.from_content(content, folder / "study.toml")


def test_displaced_receivers_keep_their_height_above_the_ground(exact: Study, tmp_path: Path) -> None:
    setup = Setup.open(sloping(exact, tmp_path), tracer=TwoRay)
    plain = setup.study.content()
    del plain["links"]["position_error_m"]
    links, powers = setup.links, []
    np.testing.assert_allclose(links.rx[:, 2], 1.5 + 0.2 * links.rx[:, 0], atol=1e-4)
    for east, north in [(1, 0), (0, 1), (-1, 0), (0, -1)]:
        rx = links.rx + np.sqrt(2) * ERROR_M * np.array([east, north, 0.2 * east])
        moved = Measurements(tx=links.tx, rx=rx, path_loss_db=np.zeros(len(links)))
        loss = path_loss(Setup.open(Study.from_content(plain, setup.study.path), TwoRay, moved).trace())
        powers.append(10 ** (-loss / 10))
    np.testing.assert_allclose(path_loss(setup.trace()), -10 * np.log10(np.mean(powers, axis=0)), atol=1e-3)


def test_a_shifted_device_keeps_its_height_above_the_ground(exact: Study, tmp_path: Path) -> None:
    content = sloping(exact, tmp_path).content()
    del content["links"]["position_error_m"]
    shifted = content | {"parameters": {"rx:*.dx": {"bounds": [-5.0, 5.0]}}}
    setup = Setup.open(Study.from_content(shifted, tmp_path / "study.toml"), tracer=TwoRay)
    links = setup.links
    rx = links.rx + np.array([3.0, 0.0, 0.6])
    moved = Measurements(tx=links.tx, rx=rx, path_loss_db=np.zeros(len(links)))
    expected = Setup.open(Study.from_content(content, tmp_path / "study.toml"), TwoRay, moved).trace()
    placed = setup.placed_at({"rx:*.dx": 3.0}).trace()
    np.testing.assert_allclose(placed.rx_position, expected.rx_position, atol=1e-3)


def test_a_region_attenuates_the_paths_to_the_displaced_receivers(exact: Study) -> None:
    """Trees between the mast and receivers at their edge: some displaced receivers are in them, others are not."""
    trees = {"boxes": [[4.0, -3.0, 12.0, 3.0]], "top": 9.0, "specific_attenuation": 1.0, "maximum_db": 40.0}
    content = exact.content() | {"regions": {"trees": trees}}
    plain = Study.from_content(content, exact.path)
    setup = Setup.open(with_error(plain), tracer=TwoRay)
    links, start, losses = setup.links, setup.parameters.start[None], []
    for angle in np.radians([0.0, 90.0, 180.0, 270.0]):
        rx = links.rx + np.sqrt(2) * ERROR_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        moved = Measurements(tx=links.tx, rx=rx, path_loss_db=np.zeros(len(links)))
        losses.append(engines.make(Setup.open(plain, tracer=TwoRay, links=moved)).path_loss(start)[0])
    expected = -10 * np.log10(np.mean(10 ** (-np.array(losses) / 10), axis=0))
    np.testing.assert_allclose(engines.make(setup).path_loss(start)[0], expected, atol=1e-3)
    weight = setup.with_position_noise().links.weight
    np.testing.assert_allclose(1 / weight, 2.0**2 + np.std(losses, axis=0) ** 2, rtol=1e-3)
    assert np.std(losses, axis=0).max() > 3.0


def test_position_noise_is_that_of_the_facades(exact: Study) -> None:
    """A wet strip of the ground, whose material is calibrated, reflects to some of the displaced receivers."""
    content = exact.content()
    content["facades"] = {"wet": {"of": "ground", "boxes": [[5.0, -9.0, 9.0, 9.0]]}}
    content["materials"]["wet"] = {"relative_permittivity": 80.0, "conductivity": 5.0}
    content["parameters"]["wet.relative_permittivity"] = {"bounds": [60.0, 90.0]}
    setup = Setup.open(with_error(Study.from_content(content, exact.path)), tracer=TwoRay)
    losses = []
    for angle in np.radians([0.0, 90.0, 180.0, 270.0]):
        rx = setup.links.rx + np.sqrt(2) * ERROR_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        moved = Measurements(tx=setup.links.tx, rx=rx, path_loss_db=np.full(len(rx), np.nan))
        losses.append(path_loss(setup.at(moved).trace()))
    weight = setup.with_position_noise().links.weight
    np.testing.assert_allclose(1 / weight, 2.0**2 + np.std(losses, axis=0) ** 2, rtol=1e-9)


def test_position_noise_is_that_of_the_antennas_at_their_start_values(exact: Study) -> None:
    """A sector of stated azimuth 50 degrees with an error that starts at 40 degrees, and one of 90 degrees."""
    weights = []
    for azimuth, start in ((50.0, 40.0), (90.0, 0.0)):
        content = with_error(exact, tx_antenna={"azimuth_deg": azimuth}).content()
        content["antennas"]["tx"]["pattern"] = "tr38901"
        content["parameters"]["tx:*.azimuth"] = {"bounds": [-60.0, 60.0], "start": start}
        setup = Setup.open(Study.from_content(content, exact.path), tracer=TwoRay)
        weights.append(setup.with_position_noise().links.weight)
    np.testing.assert_allclose(weights[0], weights[1], rtol=1e-9)


def test_position_noise_is_that_of_the_heights_at_their_start_values(exact: Study) -> None:
    """A mast whose parameter starts 5 m above its stated height, and one whose height is stated right."""
    weights, table = [], exact.measurements().frame
    for stated, start in ((0.0, 5.0), (5.0, 0.0)):
        table.assign(tx_z=table["tx_z"] + stated).to_csv(
            exact.path.parent / "raised.csv", index=False, float_format="%.17g"
        )
        content = with_error(exact, file="raised.csv").content()
        content["parameters"]["tx:*.height"] = {"bounds": [-8.0, 8.0], "start": start}
        setup = Setup.open(Study.from_content(content, exact.path), tracer=TwoRay)
        weights.append(setup.with_position_noise().links.weight)
    np.testing.assert_allclose(weights[0], weights[1], rtol=1e-9)


def test_a_column_of_errors_and_exact_predictions(exact: Study) -> None:
    table = exact.measurements().frame.assign(error=0.0)
    table.to_csv(exact.path.parent / "errors.csv", index=False, float_format="%.17g")
    setup = Setup.open(with_error(exact, file="errors.csv", position_error_m="error"), tracer=TwoRay)
    plain = path_loss(Setup.open(exact, tracer=TwoRay).trace())
    np.testing.assert_allclose(path_loss(setup.trace()), plain, atol=1e-9)
    new = Measurements(tx=setup.links.tx, rx=setup.links.rx, path_loss_db=np.full(len(plain), np.nan))
    predicted = Setup.open(with_error(exact), tracer=TwoRay, links=new)
    assert predicted.trace().num_paths == Setup.open(exact, tracer=TwoRay).trace().num_paths
    assert predicted.with_position_noise() is predicted


def test_a_study_with_errors_is_calibrated(exact: Study) -> None:
    result = cb.calibrate(with_error(exact), tracer=TwoRay)
    assert np.isfinite(result.rmse_db)
    assert (
        result.intervals["ground.relative_permittivity"].lower
        < result.parameters["ground.relative_permittivity"]
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"noise": {}}, r"give links.std or noise.std_db"),
        ({"objective": {"combining": "coherent"}}, r"combined with objective.combining = 'coherent'"),
        ({"engine": {"name": "retrace"}}, r"combined with engine.name = 'retrace'"),
        ({"parameters": {"ground.itu_a": {"bounds": [2, 9]}}}, r"combined with coefficients of laws"),
        (
            {"observables": {"k": {"kind": "k_factor", "column": "k", "unit": "dB"}}},
            r"combined with \[observables\]",
        ),
    ],
)
def test_studies_that_errors_do_not_suit_are_refused(
    exact: Study, change: dict[str, object], message: str, tmp_path: Path
) -> None:
    content = with_error(exact).content() | change
    with pytest.raises(InputError, match=message):
        Study.from_content(content, tmp_path / "study.toml")


def test_negative_errors_are_refused(exact: Study) -> None:
    with pytest.raises(InputError, match=r"links.position_error_m: -1 must be at least 0"):
        Setup.open(with_error(exact, position_error_m=-1.0), tracer=TwoRay).trace()
