"""Several carriers on one trace: equal to Sionna RT at each, laws recovered, every engine told the carrier."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.engines import ReplayCarriers, fingerprint
from calibray.errors import InputError
from calibray.fields import path_gains, path_loss
from calibray.materials import itu_law
from calibray.measurements.observables import Statistic
from calibray.paths import Paths, take_links
from calibray.scenes import read_scene
from calibray.study import Setup, Study
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from small_scenes import block, write_scene

CARRIERS = (3.5e9, 10e9, 28e9)
ROUGH = {"walls": {"scattering_coefficient": 0.3, "xpd_coefficient": 0.2}}
BSDF = "".join(
    f'<bsdf type="itu-radio-material" id="mat-{name}"><string name="type" value="{kind}"/>'
    f'<float name="thickness" value="{thickness}"/></bsdf>'
    for name, kind, thickness in (("walls", "concrete", 0.1), ("soil", "wood", 0.3))
)
TX = (-20.0, 1.0, 6.0)
TRUTH = {"walls.itu_a": 6.1, "walls.itu_b": -0.07, "walls.itu_c": 0.03, "walls.itu_d": 0.9}
LAW = {
    "walls.itu_a": {"bounds": [3.0, 12.0], "start": "itu:concrete"},
    "walls.itu_b": {"bounds": [-0.2, 0.1]},
    "walls.itu_c": {"bounds": [0.005, 0.2], "scale": "log"},
    "walls.itu_d": {"bounds": [0.3, 1.3]},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ground of wood, a screen and a house of concrete, constants by ITU-R's laws."""
    folder = tmp_path_factory.mktemp("carriers")
    ground = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    screen = [[(0.0, -9.0, 0.0), (0.0, 9.0, 0.0), (0.0, 9.0, 9.0), (0.0, -9.0, 9.0)]]
    house = block((4, 12, 0), (14, 20, 8))
    file = write_scene(folder, {"ground": ground, "screen": screen, "house": house}, BSDF, "mat-walls")
    text = file.read_text()
    file.write_text(text.replace('ground.ply"/><ref id="mat-walls"', 'ground.ply"/><ref id="mat-soil"'))
    return folder


def receivers(count: int = 8) -> np.ndarray:
    """Receivers behind the screen and before it, outside the house."""
    return np.random.default_rng(8).uniform((-15, -6, 1.5), (20, 8, 4), (count, 3)).round(2)


def table(carriers: tuple[float, ...] = CARRIERS) -> pd.DataFrame:
    """Every receiver at every carrier, in mixed order."""
    rows = [(*TX, *rx, frequency) for frequency in carriers for rx in receivers()]
    columns = ["tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z", "carrier"]
    return pd.DataFrame(rows, columns=columns).sample(frac=1, random_state=5).reset_index(drop=True)


def study(folder: Path, loss: np.ndarray | float = 90.0, name: str = "study", **sections: Any) -> Study:
    """A study of the links at three carriers, written beside the scene; sections given replace those here."""
    frame = table()
    frame.assign(loss=loss).to_csv(folder / f"{name}.csv", index=False, float_format="%.17g")
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": 10e9},
        "links": {
            "file": f"{name}.csv",
            "tx": ["tx_x", "tx_y", "tx_z"],
            "rx": ["rx_x", "rx_y", "rx_z"],
            "value": "loss",
            "frequency": "carrier",
        },
        "trace": {"max_depth": 2, "samples": 20_000, "refraction": True},
        "parameters": LAW,
        **sections,
    }
    return Study.from_content(content, folder / f"{name}.toml")


@pytest.fixture(scope="module")
def replay(folder: Path) -> ReplayCarriers:
    engine = engines.make(study(folder))
    assert isinstance(engine, ReplayCarriers)
    return engine


@pytest.fixture(scope="module")
def truth(replay: ReplayCarriers) -> np.ndarray:
    """Path loss of the planted law [L]."""
    return replay.path_loss(vector(TRUTH)[None])[0]


def vector(values: dict[str, float]) -> np.ndarray:
    return np.array([values[name] for name in LAW])


def traced_at_ten(folder: Path) -> Paths:
    """The paths of the study's links at 10 GHz, out of the cache once they were traced."""
    plan = study(folder)
    links = plan.measurements()
    ten = links.select(links.frequency == 10e9)
    return Setup.open(plan, links=ten).trace()


# The physics at another carrier


def test_further_observables_at_several_carriers_have_exact_derivatives(replay: ReplayCarriers) -> None:
    value, wanted = vector(TRUTH)[None], (Statistic("rms_delay_spread"), Statistic("k_factor"))
    answer = replay.respond(value, wanted, derivatives=True)
    assert answer.path_loss == pytest.approx(replay.path_loss(value))
    assert answer.loss_slope == pytest.approx(replay.path_loss_and_jacobian(value)[1], abs=1e-9)
    for index, name in enumerate(LAW):
        step = 1e-5 * np.eye(len(LAW))[index]
        above, below = replay.respond(np.vstack([value + step, value - step]), wanted).observed
        numeric = (above - below)[np.isfinite(above)] / 2e-5
        slope = answer.observed_slope[0, ..., index][np.isfinite(above)]
        np.testing.assert_allclose(slope, numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max(), err_msg=name)


def test_paths_at_another_carrier_are_those_that_sionna_traces_there(folder: Path) -> None:
    """With diffraction and diffuse reflection; without refraction, so that the paths found are the same."""
    settings = TraceSettings(max_depth=2, samples=3000, diffraction=True, diffuse_reflection=True)
    links = SimpleNamespace(tx=np.tile(TX, (6, 1)), rx=receivers(6))

    def tracer(frequency: float) -> Tracer:
        scene = read_scene(folder / "scene.xml", frequency, ROUGH)
        return Tracer(scene, frequency, settings, Antenna("dipole"), Antenna("tr38901", "VH"))

    traced = tracer(10e9).trace(links)
    assert set(traced.kind) == {1, 2, 8}
    for frequency in (3.5e9, 28e9):
        there = tracer(frequency)
        trace = there.find_paths(links)
        paths = traced.at(frequency, there.scene.materials)
        theirs, ours = trace.path_gains(), path_gains(paths)
        np.testing.assert_array_equal(trace.link(), paths.link)
        strength = np.abs(theirs).max(axis=(1, 2))
        strongest = np.maximum.reduceat(strength, np.flatnonzero(np.diff(paths.link, prepend=-1)))
        error = np.abs(ours - theirs).max(axis=(1, 2))
        assert (error < 1e-3 * strength + 1e-6 * strongest[paths.link]).all()
        power = np.bincount(paths.link, (np.abs(theirs) ** 2).sum(axis=(1, 2)), 6)
        np.testing.assert_allclose(path_loss(paths), -10 * np.log10(power), atol=0.01)
        stale = path_gains(traced.at(frequency))  # the constants of the carrier traced at
        assert (np.abs(stale - ours).max(axis=(1, 2)) / strength > 0.05).any()


def test_paths_of_some_links_are_theirs_in_any_order(folder: Path) -> None:
    paths = traced_at_ten(folder)
    order = np.array([3, 0, 3, 5])
    some = take_links(paths, order)
    assert some.num_links == 4
    np.testing.assert_array_equal(some.rx_position, paths.rx_position[order])
    for link, original in enumerate(order):
        for name in ("delay", "tx_field", "arrival"):
            mine, theirs = (
                getattr(some, name)[some.link == link],
                getattr(paths, name)[paths.link == original],
            )
            np.testing.assert_array_equal(mine, theirs)
        mine, theirs = (
            np.concatenate([each.cos_incidence[each.first[p] : each.first[p + 1]] for p in found])
            for each, found in (
                (some, np.flatnonzero(some.link == link)),
                (paths, np.flatnonzero(paths.link == original)),
            )
        )
        np.testing.assert_array_equal(mine, theirs)
    assert take_links(paths, np.zeros(0)).num_paths == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0,), r"frequency = 0\.0: must be from 1e\+06 to 1e\+12 Hz"),
        ((28.5,), r"frequency = 28\.5: .*write 28\.5 GHz as 28\.5e9"),
        ((float("nan"),), "frequency = nan"),
        ((1e9, {"glass": None}), "no material 'glass' in the traced scene, which has soil, walls"),
    ],
)
def test_carriers_that_are_none_and_materials_that_are_not_there(
    folder: Path, arguments: tuple, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        traced_at_ten(folder).at(*arguments)


# Engines


def test_replay_is_that_of_the_fields_at_each_carrier_in_the_links_order(
    folder: Path, replay: ReplayCarriers, truth: np.ndarray
) -> None:
    """Constants by hand from the law; the others from ITU-R at the carrier."""
    plan = study(folder)
    links = plan.measurements()
    paths = plan.opened().trace()
    for frequency in CARRIERS:
        materials = read_scene(folder / "scene.xml", frequency).materials
        ghz = frequency / 1e9
        wall = materials["walls"].__class__(6.1 * ghz**-0.07, 0.03 * ghz**0.9, 0.1)
        expected = path_loss(paths.at(frequency, {**materials, "walls": wall}))
        at = links.frequency == frequency
        np.testing.assert_allclose(truth[at], expected[at], atol=1e-9)
        assert np.abs(truth[~at] - expected[~at]).max() > 1


def test_retracing_and_replaying_agree(folder: Path) -> None:
    """Without refraction, of which a trace at 28 GHz samples too little to find what one at 10 GHz finds."""
    plan = study(folder, trace={"max_depth": 2, "samples": 20_000})
    retrace, replay = engines.make(plan, "retrace"), engines.make(plan, "replay")
    points = np.stack([vector(TRUTH), replay.parameters.start])
    theirs = retrace.path_loss(points)
    np.testing.assert_allclose(replay.path_loss(points), theirs, atol=0.01)
    assert np.isfinite(theirs[0]).sum() >= 9
    assert retrace.calls == 2


def test_links_that_differ_in_their_carrier_alone_are_traced_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    seen: list[int] = []
    original: Callable = Tracer.trace

    def trace(self: Tracer, links: Any, *others: Any) -> Any:
        seen.append(len(links.rx))
        return original(self, links, *others)

    monkeypatch.setattr(Tracer, "trace", trace)
    plan = study(folder)
    links = plan.measurements()
    paths = plan.opened().trace()
    assert seen == [len(receivers())]
    np.testing.assert_array_equal(paths.rx_position, links.rx)
    assert paths.num_links == len(links) == 3 * len(receivers())


def test_one_carrier_in_a_column_is_the_same_as_none(folder: Path) -> None:
    """With constants as parameters bit for bit; with laws on the carrier's own engine as well."""
    constants = {"walls.relative_permittivity": {"bounds": [2, 9]}, "soil.conductivity": {"bounds": [0, 1]}}
    plan, laws = study(folder, parameters=constants), study(folder)
    links = plan.measurements()
    ten = links.select(links.frequency == 10e9)
    paths = traced_at_ten(folder)
    alone = replace(ten, frequency=None)
    single, several = (
        engines.make(Setup.open(plan, links=each), "replay", paths=paths) for each in (alone, ten)
    )
    assert isinstance(single, engines.Replay)
    point = np.array([[5.5, 0.2]])
    for mine, theirs in zip(
        several.path_loss_and_jacobian(point), single.path_loss_and_jacobian(point), strict=True
    ):
        np.testing.assert_array_equal(mine, theirs)
    lawful, scene = engines.make(Setup.open(laws, links=alone), "replay", paths=paths), plan.opened().scene
    same = single.path_loss([[6.1 * 10**-0.07, scene.materials["soil"].conductivity]])
    wall = {**TRUTH, "walls.itu_c": scene.materials["walls"].conductivity, "walls.itu_d": 0.0}
    np.testing.assert_allclose(lawful.path_loss(vector(wall)[None]), same, atol=1e-9)


def test_derivatives_by_the_coefficients_are_central_differences(replay: ReplayCarriers) -> None:
    at = vector(TRUTH)
    loss, jacobian = replay.path_loss_and_jacobian(at[None])
    np.testing.assert_allclose(loss, replay.path_loss(at[None]), rtol=1e-13)
    for k in range(len(LAW)):
        slopes = []
        for step in (4e-4 * abs(at[k]), 2e-4 * abs(at[k])):
            shift = step * np.eye(len(LAW))[k]
            ahead, behind = (replay.path_loss(point[None])[0] for point in (at + shift, at - shift))
            slopes.append((ahead - behind) / (2 * step))
        expected = (4 * slopes[1] - slopes[0]) / 3
        np.testing.assert_allclose(jacobian[0, :, k], expected, rtol=1e-5, atol=1e-6)
        assert np.abs(expected).max() > 0.1


MODEL = """
import json, sys
request = json.load(open(sys.argv[1]))
assert request["frequency"] == 10e9
carriers = {entry["frequency"]: entry["materials"] for entry in request["carriers"]}
wall = lambda materials: next(entry for entry in materials if entry["name"] == "walls")
loss = [
    50 + wall(carriers[f])["relative_permittivity"] + 100 * wall(carriers[f])["conductivity"] + f / 1e9
    for f in request["links"]["frequency"]
]
json.dump({"path_loss_db": loss}, open(sys.argv[2], "w"))
"""


def test_a_program_gets_the_carrier_of_every_link_and_the_constants_there(folder: Path) -> None:
    (folder / "model.py").write_text(MODEL)
    engine = {"name": "command", "command": [sys.executable, "model.py"], "retries": 0}
    plan = study(folder, engine=engine)
    (loss,) = engines.make(plan).path_loss(vector(TRUTH)[None])
    ghz = plan.measurements().frequency / 1e9
    np.testing.assert_allclose(loss, 50 + 6.1 * ghz**-0.07 + 3 * ghz**0.9 + ghz, rtol=1e-12)


def test_fingerprint_tells_carriers_and_fixed_coefficients_apart(folder: Path) -> None:
    def mark(**sections: Any) -> str:
        plan = study(folder, **sections)
        return fingerprint(plan.opened())

    few = {name: LAW[name] for name in ("walls.itu_a", "walls.itu_c")}
    other = {"walls": {"itu": "concrete", "revision": "P.2040-1"}}  # another exponent of the conductivity
    alone = study(folder).links.model_dump(exclude={"frequency"}) | {"where": "carrier == 10e9"}
    column = alone | {"frequency": "carrier"}
    marks = [
        *(mark(), mark(parameters=few), mark(parameters=few, materials=other)),
        *(mark(links=alone), mark(links=column)),
    ]
    assert len(set(marks)) == 5
    start = {**LAW, "walls.itu_b": {"bounds": [-0.1, 0.1], "start": 0.05}}
    assert mark(parameters=start) == marks[0]


# A calibration


@pytest.fixture(scope="module")
def result(folder: Path, truth: np.ndarray) -> Result:
    plan = study(folder, truth, "planted", method={"name": "least-squares", "options": {"starts": 6}})
    return calibrate(plan, out=folder / "out")


def test_a_planted_law_is_recovered_from_three_carriers(result: Result) -> None:
    assert result.rmse_db < 1e-5
    assert result.initial_rmse_db > 0.5
    assert result.fit.retrace_gap_db < 0.01  # traced again at the scene's carrier, compared at all
    for name, value in TRUTH.items():
        assert result.parameters[name] == pytest.approx(value, rel=1e-3)
        assert result.intervals[name].verdict == "identified"


def test_one_constant_at_all_carriers_cannot_tell_what_the_law_tells(folder: Path, truth: np.ndarray) -> None:
    """The negative control: with constants that do not follow the frequency a residual remains."""
    constants = {
        "walls.relative_permittivity": {"bounds": [2.0, 12.0]},
        "walls.conductivity": {"bounds": [0.001, 2.0], "scale": "log"},
    }
    method = {"name": "least-squares", "options": {"starts": 6}}
    assert calibrate(study(folder, truth, "constant", parameters=constants, method=method)).rmse_db > 0.3


def test_result_keeps_the_law_and_writes_the_constants_at_the_scenes_carrier(
    folder: Path, result: Result
) -> None:
    content = json.loads((folder / "out" / "result.json").read_text())
    assert content["fit"]["laws"]["walls"]["itu_b"] == result.parameters["walls.itu_b"]
    again = Result.load(folder / "out")
    assert again.fit.laws == result.fit.laws
    wall = read_scene(folder / "out" / "result-scene.xml", 10e9).materials["walls"]
    assert wall.relative_permittivity == pytest.approx(6.1 * 10**-0.07, rel=1e-3)
    assert wall.conductivity == pytest.approx(0.03 * 10**0.9, rel=1e-3)


def test_prediction_takes_the_carrier_of_each_link_or_else_the_scenes(
    folder: Path, result: Result, truth: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    frame = table()
    np.testing.assert_allclose(Result.load(folder / "out").predict(frame), truth, atol=1e-3)
    assert not caplog.messages
    ten = frame["carrier"] == 10e9
    without = result.predict(frame.drop(columns="carrier"))
    np.testing.assert_allclose(without[ten], truth[ten], atol=1e-3)
    assert np.abs(without[~ten] - truth[~ten]).max() > 1
    (warning,) = caplog.messages
    assert "lacks the column of carriers 'carrier'" in warning
    assert "scene.frequency = 10 GHz" in warning
    caplog.clear()
    result.predict(frame.assign(carrier=np.where(ten, 10e9, 3 * frame["carrier"].max())))
    (warning,) = caplog.messages
    assert f"{(~ten).sum()} of {len(frame)} links have carriers outside" in warning


# Bad input


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            28.5,
            r"row 3: the frequency 28\.5 must be between 1e\+06 and 1e\+12 Hz .*write 28\.5 GHz as 28\.5e9",
        ),
        (-1e9, r"row 3: the frequency -1e\+09 must be"),
        (np.nan, r"column 'carrier' has missing or non-finite values in 1 of 24 rows \(row 3\)"),
    ],
)
def test_frequencies_that_are_none(folder: Path, value: float, message: str) -> None:
    plan = study(folder, name="bad")
    frame = pd.read_csv(plan.links_path)
    frame["carrier"] = frame["carrier"].astype(float).where(frame.index != 1, value)
    frame.to_csv(plan.links_path, index=False)
    with pytest.raises(InputError, match=message):
        plan.measurements()


def test_a_column_of_too_many_frequencies_or_none(folder: Path) -> None:
    plan = study(folder, name="many")
    frame = pd.concat([pd.read_csv(plan.links_path)] * 2).assign(carrier=np.arange(48) * 1e6 + 1e9)
    frame.to_csv(plan.links_path, index=False)
    with pytest.raises(
        InputError, match="48 different frequencies, but at most 32 are allowed; give the carrier"
    ):
        plan.measurements()
    links = plan.links.model_dump() | {"frequency": "carier"}
    with pytest.raises(InputError, match="no column 'carier'; did you mean 'carrier'"):
        study(folder, name="many", links=links).measurements()


def test_the_same_value_at_another_carrier_is_no_repeat(folder: Path) -> None:
    assert len(study(folder, 90.0).measurements()) == 24
    links = study(folder).links.model_dump(exclude={"frequency"})
    merged = study(folder, 90.0, links=links).measurements()
    assert len(merged) < 24
    assert merged.prepared == {"rows that repeat a link, merged": 24 - len(merged)}


def test_a_law_that_leaves_physics_at_a_carrier_is_refused_with_it(folder: Path) -> None:
    wide = {**LAW, "walls.itu_b": {"bounds": [-0.4, 0.1]}}
    message = (
        r"walls\.itu_a = 3 with itu_b = -0\.4 results in relative_permittivity = 0\.7911 at 28 GHz, must be"
    )
    with pytest.raises(InputError, match=message):
        engines.make(study(folder, parameters=wide))


def test_a_material_whose_law_does_not_reach_a_carrier_is_named(folder: Path) -> None:
    with pytest.raises(InputError, match="'wet_ground' at 1 to 10 GHz, not at 28 GHz: give relative_perm"):
        engines.make(study(folder, materials={"soil": {"itu": "wet_ground"}}))


def test_scene_tells_how_constants_follow_the_frequency(folder: Path) -> None:
    overrides = {"walls": {"conductivity": 0.2}, "soil": {"itu": "brick", "revision": "P.2040-1"}}
    laws = read_scene(folder / "scene.xml", 10e9, overrides).laws
    assert laws["walls"][2:] == (5.24, 0.0, 0.2, 0.0)
    assert laws["soil"] == itu_law("brick", 10e9, "P.2040-1")
    assert read_scene(folder / "scene.xml", 10e9).laws["soil"] == itu_law("wood", 10e9)
