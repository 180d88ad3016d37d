"""`calibray run` on a program that answers with rays: three calls, and then everything as on replay."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import calibray as cb
import two_ray
from calibray.calibration.result import Result
from calibray.engines.rays.export import Exporting
from calibray.errors import EngineError, InputError
from calibray.fitting import ray_fit
from calibray.reporting.page import collect
from calibray.reporting.viewer import with_stored_paths
from calibray.result.held_out import Model
from calibray.study.toml_file import study_text
from commands import run

TRUTH = 7.7
PROGRAM = """
import cmath, json, math, sys
with open(sys.argv[1]) as file:
    request = json.load(file)
open("calls.log", "a").write("x")
permittivity = {entry["name"]: entry["relative_permittivity"] for entry in request["materials"]}["ground"]
rows, wavelength = [], 299792458 / request["frequency"]
eta = permittivity - 17.98j * 0.02 / (request["frequency"] / 1e9)  # ITU-R P.2040-3, a half-space of 0.02 S/m
def add(number, points, gain):
    length = sum(math.dist(a, b) for a, b in zip(points, points[1:]))
    level = 20 * math.log10(wavelength / (4 * math.pi * length)) + gain + DBI
    types = ["transmitter", "reflection", "receiver"] if len(points) == 3 else ["transmitter", "receiver"]
    for place, (point, kind) in enumerate(zip(points, types)):
        rows.append([number, place, kind, *point, level])
for number, (tx, rx) in enumerate(zip(request["links"]["tx"], request["links"]["rx"])):
    share = tx[2] / (tx[2] + rx[2])
    ground = [a + share * (b - a) for a, b in zip(tx[:2], rx[:2])] + [0.0]
    cosine = tx[2] / math.dist(tx, ground)
    root = cmath.sqrt(eta - 1 + cosine**2)
    gain = 20 * math.log10(abs((cosine - root) / (cosine + root)))  # horizontal polarization, P.2040-3 (31a)
    RIPPLE
    add(2 * number, [tx, rx], 0.0)
    add(2 * number + 1, [tx, ground, rx], gain)
names = ["path", "point", "type", "x", "y", "z", "power_db"]
with open(sys.argv[2], "w") as file:
    json.dump({name: [row[k] for row in rows] for k, name in enumerate(names)}, file)
"""
RIPPLE = "gain += math.sin(3 * permittivity + number)"
BOTH_PATHS = "    add(2 * number, [tx, rx], 0.0)\n    add(2 * number + 1, [tx, ground, rx], gain)\n"
ONE_PATH = """    if permittivity < 4: add(2 * number, [tx, rx], 0.0)
    else: add(2 * number + 1, [tx, ground, rx], gain)
"""
SECOND_WITHOUT = """if len(open("calls.log").read()) == 2:
        gain = -math.inf
    add(2 * number, [tx, ground, rx], gain)
    continue"""


ISOTROPIC = {"pattern": "iso", "polarization": "H"}


def write_study(folder: Path, ripple: str = "pass", antennas: dict | None = None, **sections: dict) -> Path:
    """A study whose program differs from replay in thickness, conductivity, polarization and antenna gain.

    It holds out two blocks in turn unless `holdout` is None.
    """
    folder.mkdir()
    (folder / "program.py").write_text(
        PROGRAM.replace("RIPPLE", ripple).replace("DBI", "0.0" if antennas else "3.5")
    )
    command = [sys.executable, "-I", "-S", "program.py"]
    sections = {"holdout": {"blocks": 2}} | sections
    content = two_ray.study(
        folder, links=16, antennas=antennas or {}, objective={"combining": "power"},
        engine={"name": "command", "command": command, "rays": True, "retries": 0},
        **{name: section for name, section in sections.items() if section is not None},
    ).content()  # fmt: skip
    (folder / "study.toml").write_text(study_text(content, {}))
    study = cb.Study.load(folder / "study.toml")
    links = pd.read_csv(folder / "links.csv")
    loss = cb.engines.make(study).path_loss(np.array([[TRUTH]]))[0]
    noise = 0.02 * np.random.default_rng(1).standard_normal(len(loss))
    links.assign(path_loss_db=loss + noise).to_csv(folder / "links.csv", index=False)
    (folder / "calls.log").unlink()
    return folder / "study.toml"


def calls(folder: Path) -> int:
    return len((folder / "calls.log").read_text())


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A finished run, and what it printed."""
    study = write_study(tmp_path_factory.mktemp("run") / "study")
    ran = run("run", study, "--out", study.parent / "out")
    assert ran.exit_code == 0, ran.output
    return study.parent, ran.output


def test_three_calls_find_the_truth_and_the_result_has_what_replay_gives(finished: tuple[Path, str]) -> None:
    folder, printed = finished
    result = Result.load(folder / "out")
    assert calls(folder) == result.rt_calls == 3
    assert result.parameters["ground.relative_permittivity"] == pytest.approx(TRUTH, abs=0.1)
    interval = result.intervals["ground.relative_permittivity"]
    assert interval.lower < TRUTH < interval.upper
    assert interval.verdict == "identified"
    assert not interval.approximate
    assert result.held_out is not None
    # The thickness of a half-space is no constant of the scene.
    assert result.materials["ground"].thickness == 1.0
    (remark,) = (each for each in result.uncertainty.remarks if each.kind == "ray mapping")
    assert remark.values["understood"]
    assert remark.values["misfit_db"] < 0.01
    assert remark.values["half_space"]
    assert remark.values["values"] == [pytest.approx(0.02, rel=0.2)]
    assert "The model represents the program" in " ".join(printed.split())


def test_a_start_on_a_logarithmic_scale_is_called_once(tmp_path: Path) -> None:
    """The exponential of the logarithm of 5.0 is another double."""
    parameter = {"bounds": [1.5, 12.0], "start": 5.0, "scale": "log"}
    study = write_study(
        tmp_path / "study", parameters={"ground.relative_permittivity": parameter}, holdout=None
    )
    result = cb.calibrate(cb.Study.load(study))
    assert calls(study.parent) == result.rt_calls == len(result.history)


def test_a_second_run_pays_for_no_call(finished: tuple[Path, str]) -> None:
    folder, _ = finished
    before = calls(folder)
    again = run("run", folder / "study.toml", "--out", folder / "out")
    assert again.exit_code == 0, again.output
    assert calls(folder) == before
    assert Result.load(folder / "out").cost.ledger_hits == 3


def test_a_validation_in_the_folder_of_the_run_pays_for_no_call(finished: tuple[Path, str]) -> None:
    folder, _ = finished
    before = calls(folder)
    validated = run("validate", folder / "study.toml", "--out", folder / "out", "--blocks", "2")
    assert validated.exit_code == 0, validated.output
    assert calls(folder) == before
    assert "RT calls that are in" in " ".join(validated.output.split())


def test_predictions_and_the_page_show_the_rays_of_the_program(
    finished: tuple[Path, str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Two calls give the rays of new links for both models of an average; their path loss is that of the program."""
    folder, _ = finished
    before, result = calls(folder), Result.load(folder / "out")
    new = pd.DataFrame([[0.0, 0.0, 10.0, 20.0, 30.0, 2.0]], columns=list(two_ray.COLUMNS))
    predicted = result.predict(new)
    assert calls(folder) == before + 2
    setup = cb.Setup.open(result.study, links=result.study.places(_rows(new)))
    model = result.prediction.model
    assert model.name == Model.AVERAGE_CALIBRATED
    used = [list(values.values()) for values in (model.parameters, model.averaged) if values is not None]
    answered = cb.engines.make(setup).path_loss(np.array(used))
    np.testing.assert_allclose(predicted, answered.mean(axis=0), atol=1e-6)
    assert "changed since the calibration" not in caplog.text
    program = folder / "program.py"
    correct = program.read_text()
    program.write_text(correct.replace("+ gain + 3.5", "+ gain + 3.4"))
    np.testing.assert_allclose(result.predict(new), predicted + 0.1, atol=1e-6)
    assert "the program or its files changed since the calibration" in caplog.text
    program.write_text(correct)
    before = calls(folder)
    assert run("report", folder / "out", "-o", tmp_path / "report.html").exit_code == 0
    page = (tmp_path / "report.html").read_text()
    assert "The model represents the program" in page
    assert calls(folder) == before
    # The rays come from the ledger; without it, the page states what is missing.
    assert "Not shown" not in page
    absent = with_stored_paths(result, tmp_path / "ledger.sqlite")
    assert collect(absent).missing == ("Paths: the paths of the engine command are not in the ledger.",)
    drawn = collect(with_stored_paths(result, folder / "out" / "ledger.sqlite")).rays
    assert drawn is not None
    assert drawn.traced == 32


def test_a_program_of_other_physics_is_not_understood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The budget ends ray mapping here; the search for an explanation takes longer after each call."""
    monkeypatch.setattr(ray_fit, "TRIALS", 5)
    method = {"name": "auto", "options": {"budget": 3}}
    antennas = {"tx": ISOTROPIC, "rx": ISOTROPIC}
    study = write_study(tmp_path / "study", RIPPLE, antennas, method=method, holdout=None)
    ran = run("run", study, "--out", tmp_path / "out")
    assert calls(study.parent) == 3
    (remark,) = (
        each for each in Result.load(tmp_path / "out").uncertainty.remarks if each.kind == "ray mapping"
    )
    assert not remark.values["understood"]
    assert remark.values["misfit_db"] > 0.2
    output = " ".join(ran.output.split())
    assert "The model does not represent the program" in output
    assert "the optimum may be missed" in output
    content = cb.Study.load(study).content() | {"method": {"name": "auto", "options": {"budget": 2}}}
    with pytest.raises(
        InputError, match=r"needs two calls.*method\.options\.budget = 2; it must be a whole number >= 3"
    ):
        cb.calibrate(cb.Study.from_content(content, study))
    assert calls(study.parent) == 3


def test_a_result_of_calls_without_a_common_path_is_loaded_and_states_the_reason(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study", holdout=None)
    program = study.parent / "program.py"
    program.write_text(program.read_text().replace(BOTH_PATHS, ONE_PATH))
    ran = run("run", study, "--out", tmp_path / "out")
    assert ran.exit_code == 0, ran.output
    assert Result.load(tmp_path / "out").rt_calls >= 3
    output = " ".join(ran.output.split())
    assert "some of its" in output
    assert "have no path, or no link with a path, in common" in output


def test_a_call_without_any_path_is_named(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study", SECOND_WITHOUT, holdout=None)
    with pytest.raises(EngineError, match=r"no path for any link at ground\.relative_permittivity = \d"):
        cb.calibrate(cb.Study.load(study))


def test_rays_that_do_not_fit_the_scene_are_refused_with_the_reason(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study")
    program = study.parent / "program.py"
    correct = program.read_text()
    for wrong, right, message in (
        ("+ [0.5]", "+ [0.0]", "from the nearest surface"),
        ('"watts"]', '"power_db"]', "states no power"),
        (
            "[1, 2]",
            "{name: [row[k] for row in rows] for k, name in enumerate(names)}",
            "has no column 'path'",
        ),
        ('"step"', '"point"', "has no column 'point', which every ray table must have"),
        (
            '{"path_loss_db": [70]}',
            "{name: [row[k] for row in rows] for k, name in enumerate(names)}",
            "instead of a ray table; remove rays = true",
        ),
    ):
        program.write_text(correct.replace(right, wrong))
        with pytest.raises(EngineError, match=message):
            cb.calibrate(cb.Study.load(study))
    program.write_text(correct.replace("json.dump", "(lambda *answer: None)"))
    with pytest.raises(EngineError, match="the response: is not a ray table"):
        cb.engines.make(cb.Study.load(study)).path_loss(np.array([[TRUTH]]))
    content = cb.Study.load(study).content()
    with pytest.raises(InputError, match=r"engine\.rays = true.*combining = 'coherent'"):
        cb.Study.from_content(content | {"objective": {"combining": "coherent"}}, study)


def test_an_incomplete_table_is_a_failure_that_is_repeated(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study")
    program = study.parent / "program.py"
    odd = "rows = rows[:-1] if len(open('calls.log').read()) % 2 else rows\nprint('every second start')"
    program.write_text(program.read_text().replace("names =", f"{odd}\nnames ="))
    content = cb.Study.load(study).content()
    candidate = np.array([TRUTH])
    patient = cb.Study.from_content(content | {"engine": {**content["engine"], "retries": 1}}, study)
    assert np.isfinite(cb.engines.make(patient).path_loss(candidate[None])).all()
    assert calls(study.parent) == 2
    # Without a further attempt, the call fails, and the next run repeats it.
    setup, ledger = cb.Setup.open(cb.Study.load(study)), tmp_path / "ledger.sqlite"
    with pytest.raises(EngineError, match=r"(?s)its path.*its output:\nevery second start.*and start again"):
        Exporting(cb.engines.make(setup, ledger=ledger), setup).export(candidate)
    assert Exporting(cb.engines.make(setup, ledger=ledger), setup).export(candidate).paths.num_paths == 32


def test_rays_without_power_are_links_without_a_path(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study")
    program = study.parent / "program.py"
    program.write_text(program.read_text().replace("*point, level]", "*point, -math.inf]"))
    loss = cb.engines.make(cb.Study.load(study)).path_loss(np.array([[TRUTH]]))
    assert np.isposinf(loss).all()


def _rows(frame: pd.DataFrame) -> object:
    from calibray.measurements import SourceTable

    return SourceTable(frame, source="links")
