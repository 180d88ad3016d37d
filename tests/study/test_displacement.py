"""Heights of transmitters and shifts of devices: interpolated between traces, verified by one more, found if wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import calibray as cb
import two_ray
from calibray import engines
from calibray.errors import InputError
from calibray.fields import DisplacementLoss, path_loss
from calibray.measurements import Measurements
from calibray.reporting.wording import scene_alone_text
from calibray.result.verdict import Remark, RemarkKind
from calibray.result.wording import remark_text
from calibray.study import Setup, Study
from calibray.study.displacement import cubics, reached
from two_ray import COLUMNS, TwoRay

GROUND = "ground.relative_permittivity"
TRUTH = {"tx:A.height": 5.0, "rx:phone.dx": 6.0, "rx:phone.dy": -4.0}
BOUNDS = {"tx:A.height": [-8, 8], "tx:B.height": [-8, 8], "rx:phone.dx": [-10, 10], "rx:phone.dy": [-10, 10]}
NOISE_DB = 1.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two masts and two devices; mast A is 5 m higher than stated, and the phone's track is displaced."""
    folder = tmp_path_factory.mktemp("displaced")
    two_ray.study(folder)
    random = np.random.default_rng(9)
    rx = np.column_stack([random.uniform(-80, 80, (160, 2)), np.full(160, 1.5)])
    mast = np.where(np.arange(160) % 2, "A", "B")
    tx = np.where((mast == "A")[:, None], [-30.0, 0.0, 15.0], [40.0, 10.0, 20.0])
    table = pd.DataFrame(np.hstack([tx, rx]), columns=COLUMNS)
    device = np.where(np.arange(160) % 4 < 2, "phone", "scanner")
    table.assign(transmitter=mast, device=device, path_loss_db=100.0).to_csv(
        folder / "stated.csv", index=False
    )
    true = table.copy()
    true.loc[mast == "A", "tx_z"] += TRUTH["tx:A.height"]
    true.loc[device == "phone", ["rx_x", "rx_y"]] += [TRUTH["rx:phone.dx"], TRUTH["rx:phone.dy"]]
    true.assign(transmitter=mast, device=device, path_loss_db=100.0).to_csv(folder / "true.csv", index=False)
    loss = path_loss(Setup.open(study(folder, "true.csv", {}), tracer=TwoRay).trace())
    noisy = loss + NOISE_DB * random.standard_normal(160)
    table.assign(transmitter=mast, device=device, path_loss_db=noisy).to_csv(
        folder / "stated.csv", index=False
    )
    return folder


def study(folder: Path, file: str, bounds: dict[str, list[float]] | None = None, **changes: object) -> Study:
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": two_ray.FREQUENCY},
        "links": {
            "file": file, "tx": COLUMNS[:3], "rx": COLUMNS[3:], "value": "path_loss_db", "device": "device",
        },
        "antennas": {"tx": {"pattern": "dipole"}, "rx": {"pattern": "dipole"}},
        "trace": {"max_depth": 1, "samples": 20_000},  # for Sionna RT, which traces predictions
        "parameters": {GROUND: {"bounds": [1.5, 15.0]}}
        | {name: {"bounds": each} for name, each in (BOUNDS if bounds is None else bounds).items()},
        "noise": {"kind": "gaussian", "range_m": 0},
    }  # fmt: skip
    return Study.from_content(content | changes, folder / "study.toml")


def test_path_loss_is_exact_at_the_traced_neighbours_and_its_derivatives_everywhere(folder: Path) -> None:
    setup = Setup.open(study(folder, "stated.csv"), tracer=TwoRay)
    engine = engines.make(setup)
    start = setup.parameters.start
    for name, end, axis, step in (
        ("tx:A.height", "tx", 2, 8.0), ("tx:A.height", "tx", 2, -4.0), ("rx:phone.dy", "rx", 1, -7.5)
    ):  # fmt: skip
        candidate = np.where(np.array(setup.parameters.names) == name, step, start)
        moved = setup.links.tx.copy(), setup.links.rx.copy()
        label = setup.links.table.labels("transmitter" if end == "tx" else "device")
        moved[end == "rx"][label == name[3:].partition(".")[0], axis] += step
        there = Measurements(*moved, path_loss_db=np.zeros(160))
        expected = path_loss(Setup.open(study(folder, "true.csv", {}), TwoRay, there).trace())
        np.testing.assert_allclose(engine.path_loss(candidate[None])[0], expected, atol=1e-9)
    candidate = start + np.array([0.5, 2.3, -3.0, 4.0, 1.0])
    _, jacobian = engine.path_loss_and_jacobian(candidate[None])
    for index in range(len(start)):
        step = 1e-4 * np.eye(len(start))[index]
        above, below = engine.path_loss(np.stack([candidate + step, candidate - step]))
        np.testing.assert_allclose(jacobian[0, :, index], (above - below) / 2e-4, rtol=1e-5, atol=1e-6)
        assert np.abs(jacobian[0, :, index]).max() > 1e-3


def test_neighbours_stay_within_the_bounds_and_beyond_them_path_loss_is_constant(folder: Path) -> None:
    opened = Setup.open(study(folder, "stated.csv", {"tx:A.height": [-8, 8]}), tracer=TwoRay)
    near = opened.placed_at({GROUND: 3.0, "tx:A.height": 6.0}, (0.125, 0.25, 0.5))
    assert near.placed_at({GROUND: 3.0, "tx:A.height": 6.0}).effects(near.trace()) == ()
    # Neighbours at 1, 2 and 4 m below; above there is room for 2 m, and a third of it comes first.
    heights = np.array([2.0, 4.0, 5.0, 6.0, 6.0 + 2 / 3, 6.0 + 4 / 3, 8.0])
    engine = engines.make(near)

    def path_loss_at(heights: np.ndarray) -> np.ndarray:
        return engine.path_loss(np.column_stack([np.full(len(heights), 3.0), heights]))

    mast = near.links.table.labels("transmitter") == "A"
    for height, loss in zip(heights, path_loss_at(heights), strict=True):
        there = Measurements(
            near.links.tx + np.array([0, 0, height]), near.links.rx, path_loss_db=np.zeros(160)
        )
        expected = path_loss(Setup.open(study(folder, "true.csv", {}), TwoRay, there).trace())
        np.testing.assert_allclose(loss[mast], expected[mast], atol=1e-9)
    between = path_loss_at(np.linspace(4.0, 5.0, 7))
    ends = np.sort(between[[0, -1]], axis=0) + np.array([[-1e-9], [1e-9]])
    assert ((ends[0] <= between) & (between <= ends[1])).all()  # a monotone cubic does not overshoot
    np.testing.assert_allclose(*path_loss_at(np.array([2.0, -8.0])), atol=1e-9)
    middle, step = np.array([[3.0, 5.4]]), np.array([0.0, 1e-4])
    _, jacobian = engine.path_loss_and_jacobian(middle)
    difference = engine.path_loss(middle + step) - engine.path_loss(middle - step)
    np.testing.assert_allclose(jacobian[..., 1], difference / 2e-4, rtol=1e-5, atol=1e-6)
    assert np.abs(jacobian[..., 1]).max() > 1e-3


def test_aimed_antennas_point_from_where_their_mast_is_placed(folder: Path) -> None:
    def aimed(bounds: dict[str, list[float]]) -> Study:
        links = study(folder, "stated.csv").content()["links"] | {"tx_antenna": {"aim": "other end"}}
        antennas = {"tx": {"pattern": "tr38901"}, "rx": {"pattern": "dipole"}}
        return study(folder, "stated.csv", bounds, links=links, antennas=antennas)

    height, material = "tx:A.height", {GROUND: 5.0}
    setup = Setup.open(aimed({height: [-8, 8]}), tracer=TwoRay).placed_at(material | {height: 5.0}, (0.5,))
    engine = engines.make(setup)
    mast = setup.links.table.labels("transmitter") == "A"
    for placed in (5.0, 1.0, 8.0):
        there = replace(setup.links, tx=setup.links.tx + np.where(mast, placed, 0.0)[:, None] * [0, 0, 1])
        direct = Setup.open(aimed({}), TwoRay, there)
        expected = path_loss(direct.trace(), direct.parameters.materials([5.0], direct.scene.materials))
        np.testing.assert_allclose(engine.path_loss(np.array([[5.0, placed]]))[0], expected, atol=1e-9)


def test_a_displacement_without_a_path_has_the_path_loss_of_the_next_one_inwards() -> None:
    change_db = np.array(
        [[np.inf, -np.inf, np.inf], [2.0, np.inf, np.nan], [0.0, 0.0, np.nan], [1.0, 4.0, np.nan]]
    )
    change_db = np.concatenate([change_db, [[np.inf, 5.0, np.nan]]])[None]
    change_db[:, 2, 2] = 0.0
    expected = [[2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 4.0, 0.0], [1.0, 5.0, 0.0]]
    np.testing.assert_array_equal(reached(change_db)[0], expected)


def test_the_error_between_the_traced_displacements_is_that_of_a_line_in_place_of_a_step() -> None:
    knots = np.array([-4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0])[None, :, None] * np.ones(3)
    # A line; a step of 6 dB between 0 and 1 m; a step farther away than the five middle knots.
    change_db = np.stack(
        [2 * knots[0, :, 0], 6.0 * (knots[0, :, 0] > 0.5), 6.0 * (knots[0, :, 0] > 3)], axis=1
    )
    none = np.zeros((0, 0))
    loss = DisplacementLoss(np.zeros(0, int), (), (none,), none, knots, cubics(knots[0], change_db)[None])
    np.testing.assert_allclose(loss.error_db, [0.0, 6 / np.sqrt(6), 0.0], atol=1e-12)
    change_db[:, 2] = 6.0 * (knots[0, :, 0] > 1.5)
    loss = replace(loss, coefficients=cubics(knots[0], change_db)[None])
    np.testing.assert_allclose(loss.error_db[2], 6 / np.sqrt(12))
    uniform = np.random.default_rng(1).uniform(size=(2, 200_000))  # where the step and the link are
    line = 6.0 * uniform[0] - 6.0 * (uniform[0] > uniform[1])
    assert np.sqrt(np.mean(line**2)) == pytest.approx(6 / np.sqrt(6), rel=0.01)


@pytest.fixture(scope="module")
def result(folder: Path) -> cb.Result:
    return cb.calibrate(study(folder, "stated.csv"), tracer=TwoRay)


def test_wrong_heights_and_shifts_are_found_and_verified_by_a_trace(folder: Path, result: cb.Result) -> None:
    for name, value in (TRUTH | {"tx:B.height": 0.0, GROUND: 3.0}).items():
        assert result.intervals[name].lower < value < result.intervals[name].upper, name
    for name in BOUNDS:
        assert result.intervals[name].upper - result.intervals[name].lower < 8.0, name
    # The last trace was at the calibrated positions.
    assert 0 < (result.fit.retrace_gap_db or 0.0) < 0.5
    blind = cb.calibrate(study(folder, "stated.csv", {}), tracer=TwoRay)
    assert blind.fit.retrace_gap_db is None
    assert result.rmse_db < blind.rmse_db - 0.2


def test_links_that_change_when_traced_again_are_counted_in_a_remark(folder: Path, result: cb.Result) -> None:
    def remark(result: cb.Result) -> list[Remark]:
        return [each for each in result.uncertainty.remarks if each.kind == RemarkKind.RETRACED]

    assert not remark(result)
    strict = cb.calibrate(
        study(folder, "stated.csv", fidelity={"rounds": 1, "tolerance_db": 0.3}), tracer=TwoRay
    )
    (found,) = remark(strict)
    gap = np.abs(strict.links["retrace_gap_db"].to_numpy())
    assert found.values["links"] == (gap > 0.3).sum() > 0
    assert f"{(gap > 0.3).sum()} of 160 links change by more than 0.3 dB" in remark_text(found)
    assert f"by up to {gap.max():.2f} dB" in remark_text(found)
    values = {"links": 0, "lost": 1, "of": 160, "tolerance_db": 0.3, "largest_db": 0.1}
    text = remark_text(Remark(RemarkKind.RETRACED, values))
    assert "values, 1 of 160 links has a path in only one of the traces. Values" in text


def test_predictions_have_the_calibrated_height_at_exact_receivers(folder: Path, result: cb.Result) -> None:
    new = pd.read_csv(folder / "true.csv")
    # Stated mast, true receivers: no shift of a track applies to new positions.
    stated = new.assign(tx_z=pd.read_csv(folder / "stated.csv")["tx_z"])
    exact = path_loss(Setup.open(study(folder, "true.csv", {}), tracer=TwoRay).trace())
    predicted = result.predict(stated)
    assert np.sqrt(np.mean((predicted - exact) ** 2)) < 0.5
    # negative control: with the stated mast, predictions are worse
    stated.to_csv(folder / "stated-masts.csv", index=False)
    uncorrected = path_loss(Setup.open(study(folder, "stated-masts.csv", {}), tracer=TwoRay).trace())
    assert np.sqrt(np.mean((uncorrected - exact) ** 2)) > 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"objective": {"combining": "coherent"}}, r"cannot be combined with objective.combining = 'coherent'"),
        ({"engine": {"name": "retrace"}}, r"cannot be combined with engine.name = 'retrace'"),
        ({"engine": {"name": "replay", "chunk_links": 5}}, r"cannot be combined with engine.chunk_links"),
        (
            {"parameters": {"tx:A.height": {"bounds": [-1, 1]}, "ground.itu_a": {"bounds": [2, 9]}}},
            r"'tx:A.height': .* cannot be combined with coefficients of laws",
        ),
        ({"parameters": {"tx:C.height": {"bounds": [-1, 1]}}}, r"no link has the transmitter 'C'"),
        ({"parameters": {"rx:PHONE.dx": {"bounds": [-1, 1]}}}, r"no link has the device 'PHONE' in column 'device'"),
    ],
)  # fmt: skip
def test_impossible_displacements_are_refused(folder: Path, change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Setup.open(study(folder, "stated.csv", **change), tracer=TwoRay)


def test_heights_are_calibrated_in_one_process(folder: Path) -> None:
    setup = Setup.open(study(folder, "stated.csv"), tracer=TwoRay)
    with pytest.raises(InputError, match=r"'tx:A.height': .* without workers \(--workers"):
        engines.make(setup, workers=engines.InProcess())


def test_held_out_blocks_judge_the_initial_materials_at_the_stated_positions(folder: Path) -> None:
    stated = study(folder, "stated.csv")
    held_out = cb.calibrate(study(folder, "stated.csv", holdout={"blocks": 4}), tracer=TwoRay).validation
    assert held_out is not None
    initial_db = held_out.table["rmse_db"]["initial materials"]
    # Here the stated positions are traced, not interpolated.
    exact_db = cb.validate(stated, tracer=TwoRay).table["rmse_db"]["initial materials"]
    assert initial_db == pytest.approx(exact_db, abs=0.02)


def test_the_scene_alone_has_the_stated_positions(folder: Path, result: cb.Result) -> None:
    stated = Setup.open(study(folder, "stated.csv", {}), tracer=TwoRay)
    materials = stated.parameters.materials([result.parameters[GROUND]], stated.scene.materials)
    expected = path_loss(stated.trace(), materials)
    np.testing.assert_allclose(result.links["scene_db"], expected, atol=1e-6)
    assert "a scene cannot contain the errors of antennas" in scene_alone_text(result)


def test_devices_need_their_column(folder: Path) -> None:
    content = study(folder, "stated.csv").content()
    del content["links"]["device"]
    with pytest.raises(InputError, match=r"'rx:phone.dx' needs links.device"):
        Study.from_content(content, folder / "study.toml")
