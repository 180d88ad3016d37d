"""A study of a Sionna RT scene in memory, and the calibrated materials in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pandas as pd
import pytest
import sionna.rt as rt

import calibray as cb
from calibray import engines
from calibray.errors import InputError
from calibray.measurements.observables import KINDS, SECTORS, Statistic
from calibray.tracing.sionna.live_scene import apply_materials
from small_scenes import write_scene

PLANTED = {"marble": 9.2, "concrete": 3.1}


def street() -> rt.Scene:
    """The bundled street with two transmitters of one antenna, and receivers along it."""
    scene = rt.load_scene(rt.scene.simple_street_canyon)
    scene.frequency = 3.5e9
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="tr38901", polarization="V")
    scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="dipole", polarization="cross")
    for number, x in enumerate((-35.0, 0.0)):
        name = f"tx{number}"
        scene.add(rt.Transmitter(name, position=[x, 0, 10], orientation=[0.3, 0.1, 0], power_dbm=20 + number))
    for number, x in enumerate(np.linspace(-25, 25, 8)):
        scene.add(rt.Receiver(f"rx{number}", position=[float(x), float(4 * np.cos(x)), 1.5]))
    return scene


def path_loss_db(scene: rt.Scene) -> np.ndarray:
    """Path loss by Sionna's own solver, power summed over receive ports [tx, rx]."""
    paths = rt.PathSolver()(scene, max_depth=2, samples_per_src=50_000, refraction=False)
    real, imaginary = (np.array(part, dtype=float) for part in paths.a)
    return -10 * np.log10((real**2 + imaginary**2).sum(axis=(1, 3, 4))).T


@pytest.fixture(scope="module")
def measured() -> np.ndarray:
    scene = street()
    for name, value in PLANTED.items():
        scene.radio_materials[name].relative_permittivity = value
    return path_loss_db(scene)


@pytest.fixture(scope="module")
def study(measured: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> cb.Study:
    return cb.Study.from_sionna(
        street(),
        measured,
        tmp_path_factory.mktemp("study"),
        trace={"max_depth": 2, "samples": 20_000},
        parameters={f"{name}.relative_permittivity": {"bounds": [1.5, 15.0]} for name in PLANTED},
    )


def test_sionna_and_the_study_agree_and_materials_are_set(study: cb.Study, measured: np.ndarray) -> None:
    """`examples/notebooks/4-sionna-notebook.ipynb` calibrates; here the materials are the planted ones."""
    scene, paths = street(), cb.trace(study)
    assert np.abs(path_loss_db(scene) - measured).max() > 0.5
    planted = {
        name: replace(paths.materials[name], relative_permittivity=value) for name, value in PLANTED.items()
    }
    apply_materials(scene, planted)
    np.testing.assert_allclose(path_loss_db(scene), measured, atol=1e-4)
    np.testing.assert_allclose(cb.path_loss(paths, planted).reshape(measured.shape), measured, atol=0.001)
    scene.frequency = scene.frequency
    for name, value in PLANTED.items():
        assert np.array(scene.radio_materials[name].relative_permittivity).item() == pytest.approx(value)
    with pytest.raises(InputError, match="no material 'walls'"):
        apply_materials(scene, {"walls": planted["marble"]})


def test_only_scattering_that_a_scene_states_is_stated_by_its_study(
    measured: np.ndarray, tmp_path: Path
) -> None:
    """Sionna RT's default of 0 is no statement of the user, after which it would count as exact."""
    scene = street()
    scene.radio_materials["marble"].scattering_coefficient = 0.3
    study = cb.Study.from_sionna(scene, measured, tmp_path)
    assert study.materials["marble"].scattering_coefficient == pytest.approx(0.3)
    assert study.materials["concrete"].scattering_coefficient is None
    assert study.opened().scene.materials["concrete"].scattering_coefficient == 0.0


def test_what_sections_do_not_state_remains_that_of_the_scene(measured: np.ndarray, tmp_path: Path) -> None:
    scene = street()
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="tr38901", polarization="V")
    for name in ("concrete", "glass"):
        pattern = rt.BackscatteringPattern(alpha_r=20, alpha_i=10, lambda_=0.5)
        scene.radio_materials[name].scattering_pattern = pattern
    study = cb.Study.from_sionna(
        scene, measured, tmp_path,
        materials={"glass": {"thickness": 0.1}, "marble": {"itu": "wood"}}, antennas={"rx": {"pattern": "dipole"}},
    )  # fmt: skip
    materials = study.opened().scene.materials
    for name in ("concrete", "glass"):
        assert materials[name].scattering_pattern == "backscattering"
        assert materials[name].alpha_i == 10
    assert materials["glass"].thickness == 0.1
    glass = np.array(scene.radio_materials["glass"].relative_permittivity).item()
    assert materials["glass"].relative_permittivity == pytest.approx(glass, rel=1e-6)
    assert materials["marble"].relative_permittivity == pytest.approx(1.99)
    assert (study.antennas.tx.pattern, study.antennas.rx.pattern) == ("tr38901", "dipole")
    assert study.antennas.known


def test_all_materials_but_air_and_metal_are_calibrated(measured: np.ndarray, tmp_path: Path) -> None:
    scene = street()
    steel = rt.RadioMaterial("steel", relative_permittivity=2.0, conductivity=1e7, thickness=0.02)
    foam = rt.RadioMaterial("foam", relative_permittivity=1.05, conductivity=0.0, thickness=0.02)
    board = rt.ITURadioMaterial("board", "ceiling_board", thickness=0.02)
    for material, name in zip((steel, foam, board), sorted(scene.objects)[:3], strict=True):
        scene.objects[name].radio_material = material
    study = cb.Study.from_sionna(scene, measured, tmp_path / "a")
    assert {name.split(".")[0] for name in study.parameters} & {"steel", "foam", "board"} == {"board"}
    assert study.parameters["board.relative_permittivity"].bounds == (1.36, 15.0)
    for item in scene.objects.values():
        item.radio_material = steel
    with pytest.raises(InputError, match="metal or air"):
        cb.Study.from_sionna(scene, measured, tmp_path / "b")


def test_objects_with_similar_names_are_different_objects(measured: np.ndarray, tmp_path: Path) -> None:
    scene = street()
    marble = scene.radio_materials["marble"]
    added = [
        rt.SceneObject(fname=rt.scene.sphere, name=name, radio_material=marble) for name in ("銀行", "病院")
    ]
    scene.edit(add=added)
    study = cb.Study.from_sionna(scene, measured, tmp_path)
    names = [item.name for item in study.opened().scene.objects]
    assert len(set(names)) == len(names)
    assert {"object-_", "object-_-2"} <= {*names}


def test_a_study_does_not_depend_on_the_order_in_which_objects_were_loaded(
    measured: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, objects = street(), rt.Scene.objects.fget
    first = cb.Study.from_sionna(scene, measured, tmp_path / "first")
    monkeypatch.setattr(rt.Scene, "objects", property(lambda live: dict(reversed(objects(live).items()))))
    second = cb.Study.from_sionna(scene, measured, tmp_path / "second")
    assert list(first.parameters) == list(second.parameters)
    assert first.path.with_name("scene.xml").read_text() == second.path.with_name("scene.xml").read_text()


def test_wet_ground_starts_within_its_default_bounds(measured: np.ndarray, tmp_path: Path) -> None:
    scene = street()
    scene.radio_materials["concrete"].relative_permittivity = 18.2
    study = cb.Study.from_sionna(scene, measured, tmp_path)
    start = dict(zip(study.parameters, study.opened().parameters.start, strict=True))
    assert start["concrete.relative_permittivity"] == pytest.approx(18.2)
    assert study.parameters["concrete.relative_permittivity"].bounds == (1.5, 36.0)
    assert study.parameters["marble.relative_permittivity"].bounds == (1.5, 15.0)


def test_materials_of_another_carrier_cause_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    scene = street()
    marble = {"marble": cb.itu_material("marble", 28e9, thickness=0.1)}
    apply_materials(scene, marble, 3.5e9)
    assert not caplog.messages
    apply_materials(scene, marble, 28e9)
    assert caplog.messages == [
        "scene.frequency is 3.5 GHz, but the calibrated constants are for 28 GHz; set scene.frequency = 28000000000.0"
    ]


def test_observables_equal_those_of_sionnas_impulse_responses(study: cb.Study) -> None:
    # The marble has 0.018 S/m, which hardly damp its slab: where it is half a wavelength thick, little is reflected
    # and the single precision of Sionna RT errs by 6e-4 in power.
    scene, lossy = street(), study.content()
    scene.radio_materials["marble"].conductivity = 0.3
    lossy["materials"] = {"marble": {"conductivity": 0.3}}
    engine = engines.make(cb.Study.from_content(lossy, study.path), "replay")
    for name, value in PLANTED.items():
        scene.radio_materials[name].relative_permittivity = value
    paths = rt.PathSolver()(scene, max_depth=2, samples_per_src=50_000, refraction=False)
    response, delays = paths.cir(normalize_delays=False)
    power = sum(np.array(part, dtype=float) ** 2 for part in response).sum(axis=(1, 3, 5))
    delay, departure, arrival = (np.array(part, dtype=float) for part in (delays, paths.phi_t, paths.phi_r))
    zenith = [np.array(part, dtype=float) for part in (paths.theta_t, paths.theta_r)]
    weight = power / power.sum(axis=-1, keepdims=True)

    def mean(value: np.ndarray) -> np.ndarray:
        return (weight * value).sum(axis=-1)

    def spread(angle: np.ndarray) -> np.ndarray:
        return np.sqrt(-2 * np.log(np.minimum(np.abs(mean(np.exp(1j * angle))), 1.0)))

    def share(inside: np.ndarray) -> np.ndarray:
        return 10 * np.log10(mean(inside) + 1e-3)

    strongest, first = weight.max(axis=-1), np.where(delay < 0, np.inf, delay).min(axis=-1)
    expected = {
        "rms_delay_spread": np.sqrt(mean((delay - mean(delay)[..., None]) ** 2)),
        "mean_excess_delay": mean(delay) - first,
        "time_of_flight": mean(delay),
        "round_trip_time": 2 * mean(delay),
        "k_factor": 10 * np.log10(strongest / (1 - strongest)),
        "azimuth_spread_departure": spread(departure),
        "azimuth_spread_arrival": spread(arrival),
    }
    expected |= {
        "elevation_spread_departure": spread(zenith[0]),
        "elevation_spread_arrival": spread(zenith[1]),
        "power_delay_profile": share((delay - first[..., None] >= 0) & (delay - first[..., None] < 5e-8)),
        "azimuth_power_departure": share(departure % (2 * np.pi) < 2.0),
        "azimuth_power_arrival": share(arrival % (2 * np.pi) < 2.0),
    }
    values = np.array([[PLANTED[name.partition(".")[0]] for name in engine.parameters.names]])
    edges = {kind: (0.0, 2.0) for kind in SECTORS} | {"power_delay_profile": (0.0, 5e-8)}
    statistics = tuple(Statistic(kind, edges=edges.get(kind)) for kind in KINDS)
    found = engine.respond(values, statistics).observed[0]
    assert set(expected) == set(KINDS)
    for kind, row in zip(KINDS, found, strict=True):
        wanted = expected[kind].T.ravel()
        # 1e-4 of a power are 4.3e-4 dB. Sionna computes in single precision: a spread of zero is one of some 1e-7 rad.
        absolute = 4.3e-4 if KINDS[kind] == "dB" else 1e-6 * np.abs(wanted).max()
        np.testing.assert_allclose(row, wanted, rtol=1e-4, atol=absolute, err_msg=kind)


def test_a_study_can_be_saved_and_loaded(study: cb.Study) -> None:
    loaded = cb.Study.load(study.path)
    assert loaded.content() == study.content()
    assert loaded.antenna_pair[0].orientation == pytest.approx((0.3, 0.1, 0))
    assert [antenna.pattern for antenna in loaded.antenna_pair] == ["tr38901", "dipole"]
    # Sionna has merged the buildings of a material.
    assert len(loaded.opened().scene.objects) == 7 > len(street().objects)


def test_values_may_be_named_missing_or_received_power(measured: np.ndarray, tmp_path: Path) -> None:
    power = pd.DataFrame(20.0 - measured[:1, ::-1], ["tx0"], [f"rx{number}" for number in range(7, -1, -1)])
    power.loc["tx0", "rx3"] = np.nan
    study = cb.Study.from_sionna(street(), power, tmp_path, links={"quantity": "received_power"})
    links = study.measurements()
    np.testing.assert_allclose(links.path_loss_db, np.delete(measured[0], 3))
    assert list(study.parameters) == [f"{name}.relative_permittivity" for name in study.materials]


def missing_of(form: str, measured: np.ndarray) -> object:
    """Measured values of which the last one of the first transmitter is missing."""
    last = np.zeros(measured.shape, dtype=bool)
    last[0, -1] = True
    frame = pd.DataFrame(measured, ["tx0", "tx1"], [f"rx{number}" for number in range(measured.shape[1])])
    return {
        "masked": np.ma.masked_array(np.where(last, 40.0, measured), mask=last),
        "pd.NA in a table": frame.astype("Float64").mask(last),
        "pd.NA in a list": np.where(last, pd.NA, measured.astype(object)).tolist(),
        "None": np.where(last, None, measured.astype(object)),
    }[form]


@pytest.mark.parametrize("form", ["masked", "pd.NA in a table", "pd.NA in a list", "None"])
def test_masked_and_missing_values_are_not_measured(measured: np.ndarray, tmp_path: Path, form: str) -> None:
    links = cb.Study.from_sionna(street(), missing_of(form, measured), tmp_path).measurements()
    np.testing.assert_allclose(links.path_loss_db, np.delete(measured.ravel(), measured.shape[1] - 1))


@pytest.mark.parametrize(
    "pattern", [rt.BackscatteringPattern(alpha_r=4, alpha_i=3, lambda_=0.7), rt.DirectivePattern(alpha_r=5)]
)
def test_scattering_patterns_are_those_of_the_scene(
    measured: np.ndarray, tmp_path: Path, pattern: rt.BackscatteringPattern
) -> None:
    scene = street()
    scene.radio_materials["marble"].scattering_coefficient = 0.3
    scene.radio_materials["marble"].scattering_pattern = pattern
    material = cb.Study.from_sionna(scene, measured, tmp_path).opened().scene.materials["marble"]
    assert f"{material.scattering_pattern.capitalize()}Pattern" == type(pattern).__name__
    assert material.alpha_r == pattern.alpha_r
    if isinstance(pattern, rt.DirectivePattern):
        return
    assert material.alpha_i == 3
    assert material.lambda_ == pytest.approx(0.7)


def test_what_is_not_a_matrix_of_path_loss_is_refused(measured: np.ndarray, tmp_path: Path) -> None:
    def refused(values: object, message: str, **sections: Any) -> None:
        with pytest.raises(InputError, match=message):
            cb.Study.from_sionna(street(), values, tmp_path, **sections)

    first = np.zeros(measured.shape, dtype=bool)
    first[0, 0] = True
    frame = pd.DataFrame(measured, ["tx0", "tx1"], [f"rx{number}" for number in range(measured.shape[1])])
    refused(np.where(first, np.inf, measured), "tx0, rx0: inf, must be a finite real number")
    refused(measured + 1j, r"tx0, rx0: \(.*j\), must be a finite real number")
    refused(frame.astype(object).mask(first, "-"), "tx0, rx0: '-', must be")
    refused("measured.csv", "read the file first")
    refused([[1.0, 2.0], [3.0]], "not a matrix of numbers")
    refused(frame.iloc[[0, 0]], "row 'tx0' is repeated; give one row for each transmitter")
    refused(frame.iloc[:, [2, 2]], "column 'rx2' is repeated")
    refused(measured > 80, "tx0, rx0: (True|False), must be a finite real number")
    refused(measured, "set the attribute frequency", scene={"frequency": 28e9})
    refused(measured, r"links: is \[1\], must be a dictionary", links=[1])
    refused(measured, "offset: is None, must be a dictionary", offset=None)


class OtherFrame(np.ndarray):
    """A table of another package, whose rows have no names."""

    columns = tuple(f"rx{number}" for number in range(7, -1, -1))


def test_columns_of_other_packages_are_not_taken_in_the_order_of_the_scene(measured: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"measured: is a .*OtherFrame, which has no row names"):
        cb.Study.from_sionna(street(), measured[:, ::-1].view(OtherFrame))


@pytest.mark.parametrize("name", ["links.csv", "study.toml", "scene.xml"])
def test_files_of_the_user_are_not_replaced(measured: np.ndarray, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("measured for a week")
    with pytest.raises(InputError, match=f"{name}: was not written by Calibray"):
        cb.Study.from_sionna(street(), measured, tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    cb.Study.from_sionna(street(), measured, tmp_path, overwrite=True)
    assert (
        cb.Study.from_sionna(street(), measured, tmp_path).measurements().path_loss_db.size == measured.size
    )


def moved_street(folder: Path, distance: float) -> rt.Scene:
    """A wall in the bundled street's place, and its devices, moved along x and y [m]."""
    corners = [
        (x + distance, 9 + distance, z) for x, z in ((-30.0, 0.0), (30.0, 0.0), (30.0, 9.0), (-30.0, 9.0))
    ]
    scene = rt.load_scene(str(write_scene(folder, {"wall": [corners]})))
    scene.frequency, original = 3.5e9, street()
    scene.tx_array, scene.rx_array = original.tx_array, original.rx_array
    for device in [*original.transmitters.values(), *original.receivers.values()]:
        position = np.array(device.position).ravel() + np.array([distance, distance, 0])
        scene.add(type(device)(device.name, position=position.tolist(), orientation=[0.3, 0.1, 0]))
    return scene


def test_a_scene_far_from_its_origin_has_lost_its_precision(
    measured: np.ndarray, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cb.Study.from_sionna(moved_street(tmp_path, 5_000.0), measured)
    assert not caplog.messages
    cb.Study.from_sionna(moved_street(tmp_path, 30_000.0), measured)
    assert "the scene reaches 30030 m from its origin" in caplog.text
    with pytest.raises(InputError, match=r"in steps of 0.03125 m; move the origin into the scene"):
        cb.Study.from_sionna(moved_street(tmp_path, 300_000.0), measured)


def test_what_a_study_cannot_state_is_refused(measured: np.ndarray, tmp_path: Path) -> None:
    def refused(scene: object, message: str, values: object = measured) -> None:
        with pytest.raises(InputError, match=message):
            cb.Study.from_sionna(scene, values, tmp_path)

    refused("street", "must be a sionna.rt scene")
    refused(street(), r"shape \(8, 2\), must be \(2, 8\)", measured.T)
    refused(street(), "column 'r' is not a receiver", pd.DataFrame(measured[:, :1], ["tx0", "tx1"], ["r"]))
    scene = street()
    scene.tx_array = rt.PlanarArray(num_rows=2, num_cols=1, pattern="iso", polarization="V")
    refused(scene, "has 2 elements")
    scene = street()
    scene.rx_array = rt.AntennaArray(
        antenna_pattern=scene.rx_array.antenna_pattern, normalized_positions=mi.Point3f(0, 0.5, 0)
    )
    refused(scene, "not at the position of the device")
    scene = street()
    scene.transmitters["tx1"].orientation = [1.0, 0, 0]
    refused(scene, "different orientations")
