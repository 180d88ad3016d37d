"""Errors of antennas' directions: equal to antennas that are mounted so; derivatives against finite differences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import planted
from calibray.engines import Replay
from calibray.engines.pose import pose_error
from calibray.fields import path_loss
from calibray.measurements.observables import Statistic
from calibray.parameters import Parameter, Parameters
from calibray.paths import Paths
from calibray.tracing.antennas import Mounting, Pose, mount
from calibray.tracing.settings import Antenna

NAMES = ("tx:a.azimuth", "tx:a.downtilt", "tx:b.gain", "tx:*.azimuth")
ANTENNAS = (
    Antenna("tr38901", "cross", rows=4, columns=2, spacing=(0.5, 0.7)),
    Antenna("hw_dipole", "VH", (0.0, 0.3, 0.2)),
)


@pytest.fixture(scope="module")
def paths() -> Paths:
    """Paths of isotropic antennas in a street."""
    return planted.engine().paths


@pytest.fixture(scope="module")
def mounting(paths: Paths) -> Mounting:
    """Links in two halves, each with its own antenna in its own direction."""
    index = (np.arange(paths.num_links) % 2).astype(int)
    yaw, tilt = np.where(index, 0.4, -0.3), np.where(index, 0.0, 0.1)
    return Mounting(
        ANTENNAS, index, Pose(yaw, tilt, np.full(paths.num_links, 0.05), np.where(index, 0.0, 0.2))
    )


@pytest.fixture(scope="module")
def labels(mounting: Mounting) -> np.ndarray:
    return np.where(mounting.index, "b", "a")


@pytest.fixture(scope="module", params=["coherent"])
def engine(request, paths: Paths, mounting: Mounting, labels: np.ndarray) -> Replay:
    materials = planted.engine().parameters
    bounds = {"azimuth": 40.0, "downtilt": 20.0, "gain": 10.0}
    errors = tuple(
        Parameter(name, -bounds[field], bounds[field], 0.0)
        for name, field in ((name, name.rpartition(".")[2]) for name in NAMES)
    )
    parameters = Parameters((*errors[:2], *materials.items, *errors[2:]), materials.frequency)
    mounted = mount(paths, {"tx": mounting})
    effect = pose_error(mounted, mounting, labels, errors, from_north=True)
    assert effect is not None
    return Replay(mounted, parameters, request.param, effects=(effect,))


def candidates(engine: Replay, count: int) -> np.ndarray:
    unit = np.random.default_rng(4).uniform(0.2, 0.8, (count, len(engine.parameters)))
    return engine.parameters.from_unit(unit)


def test_errors_are_those_of_antennas_mounted_otherwise(
    engine: Replay, paths: Paths, mounting: Mounting, labels: np.ndarray
) -> None:
    values = candidates(engine, 3)
    for value, loss in zip(values, engine.path_loss(values), strict=True):
        named = engine.parameters.named(value)
        yaw = mounting.pose.yaw - np.radians(named["tx:*.azimuth"])
        yaw = yaw - np.radians(named["tx:a.azimuth"]) * (labels == "a")
        tilt = mounting.pose.downtilt + np.radians(named["tx:a.downtilt"]) * (labels == "a")
        pose = mounting.pose._replace(yaw=yaw, downtilt=tilt)
        turned = mount(paths, {"tx": replace(mounting, pose=pose)})
        materials = engine.parameters.materials(value, paths.materials)
        expected = path_loss(turned, materials, combining=engine._combining.kind)
        np.testing.assert_allclose(loss, expected - named["tx:b.gain"] * (labels == "b"), atol=1e-9)


def test_a_changed_file_of_gains_counts_at_once(paths: Paths, tmp_path: Path) -> None:
    errors, links = (Parameter("tx:*.azimuth", -40.0, 40.0, 0.0),), np.zeros(paths.num_links)
    parameters = Parameters((*planted.engine().parameters.items, *errors))
    file = tmp_path / "horn.csv"
    mounting = Mounting((Antenna(str(file)),), links.astype(int), Pose(links, links, links, links))
    for lost_db in (0.0, 10.0):  # behind the antenna
        azimuth, elevation = np.meshgrid(np.arange(-180, 180, 15), np.arange(-90, 91, 15))
        columns = {
            "azimuth_deg": azimuth,
            "elevation_deg": elevation,
            "gain_dbi": -lost_db * np.abs(azimuth) / 180,
        }
        pd.DataFrame({name: values.ravel() for name, values in columns.items()}).to_csv(file, index=False)
        mounted = mount(paths, {"tx": mounting})
        effect = pose_error(mounted, mounting, links.astype(str), errors, from_north=True)
        assert effect is not None
        loss = Replay(mounted, parameters, effects=(effect,)).path_loss(parameters.start[None])[0]
        expected = path_loss(mounted, parameters.materials(parameters.start, paths.materials))
        np.testing.assert_allclose(loss, expected, atol=1e-9)


def test_derivatives_agree_with_finite_differences(engine: Replay) -> None:
    value = candidates(engine, 1)
    _, jacobian = engine.path_loss_and_jacobian(value)
    for index, name in enumerate(engine.parameters.names):
        step = 1e-4 * np.eye(len(engine.parameters))[index]
        above, below = engine.path_loss(np.vstack([value + step, value - step]))
        np.testing.assert_allclose(
            jacobian[0, :, index], (above - below) / 2e-4, rtol=1e-5, atol=1e-6, err_msg=name
        )
        assert np.abs(jacobian[0, :, index]).max() > 1e-3


def test_derivatives_of_further_observables_agree_with_finite_differences(engine: Replay) -> None:
    value, wanted = (
        candidates(engine, 1),
        (Statistic("rms_delay_spread"), Statistic("azimuth_spread_arrival")),
    )
    answer = engine.respond(value, wanted, derivatives=True)
    # Fields combine coherently to path loss, powers to all other observables.
    assert answer.path_loss == pytest.approx(engine.path_loss(value))
    assert answer.loss_slope == pytest.approx(engine.path_loss_and_jacobian(value)[1])
    assert answer.observed == pytest.approx(engine.respond(value, wanted).observed, rel=1e-12)
    for index, name in enumerate(engine.parameters.names):
        step = 1e-4 * np.eye(value.shape[1])[index]
        above, below = engine.respond(np.vstack([value + step, value - step]), wanted).observed
        numeric = (above - below) / 2e-4
        # The gain of an antenna changes no spread but by rounding.
        scale = np.abs(numeric).max(axis=1, keepdims=True) + 1e-4 * above.max(axis=1, keepdims=True)
        slope = answer.observed_slope[0, :, :, index]
        np.testing.assert_allclose(slope / scale, numeric / scale, atol=1e-5, err_msg=name)


def test_without_such_parameters_there_is_no_effect(
    paths: Paths, mounting: Mounting, labels: np.ndarray
) -> None:
    region = Parameter("region:trees.specific_attenuation", 0.0, 3.0, 0.4)
    assert pose_error(paths, mounting, labels, [region], from_north=True) is None


def test_errors_of_antennas_that_no_link_has_have_no_slope(paths: Paths) -> None:
    """In a chunk of links, or at candidates of another transmitter, every parameter has its derivative."""
    materials = planted.engine().parameters
    foreign = (Parameter("tx:c.azimuth", -40.0, 40.0, 0.0), Parameter("tx:c.gain", -10.0, 10.0, 0.0))
    loss, jacobian = Replay(paths, materials).path_loss_and_jacobian(materials.start[None])
    for items, columns in (((foreign[0], *materials.items, foreign[1]), [1, 2, 3]), (foreign, [])):
        parameters = Parameters(items, materials.frequency)
        answer = Replay(paths, parameters).path_loss_and_jacobian(parameters.start[None])
        expected = np.zeros((*loss.shape, len(items)))
        expected[..., columns] = jacobian[..., : len(columns)]
        np.testing.assert_allclose(answer[0], loss, rtol=1e-12)
        np.testing.assert_allclose(answer[1], expected, rtol=1e-12)
