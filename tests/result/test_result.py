"""A result's files hold all of it, predict where it was fitted, and are never half-written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import numpy as np
import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

import planted
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.errors import InputError
from calibray.reporting.result_tables import nuisances
from calibray.reporting.summary import summary
from calibray.result.files import FILES
from calibray.result.held_out import HeldOutErrors, Model
from calibray.result.verdict import Remark, RemarkKind
from calibray.result.wording import NOT_JUDGED
from calibray.scenes import read_scene
from calibray.study import Study
from calibray.support.output_files import SIGNATURES
from small_scenes import write_scene

pytestmark = pytest.mark.usefixtures("own_cache")

OFFSETS = {"west": -3.0, "east": 6.0}


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> Result:
    """A calibration with noise, one offset per half, and a hold-out."""
    table = planted.campaign(noise_db=0.3)
    study = planted.study(
        tmp_path_factory.mktemp("study"),
        table.assign(path_loss_db=table.path_loss_db + table.half.map(OFFSETS)),
        offset={"per": "half"},
        holdout={"where": "rx_x > 15"},
        method={"name": "auto", "options": {"starts": 16}},
    )
    return calibrate(study, engine=planted.engine())


@pytest.fixture
def folder(result, tmp_path):
    """The folder it was saved into."""
    result.save(tmp_path / "new" / "out")
    return tmp_path / "new" / "out"


def test_a_result_that_was_copied_with_its_study_reads_the_files_there(result, tmp_path):
    before, after = tmp_path / "before", tmp_path / "after"
    before.mkdir()
    (before / "study.toml").touch()
    here = Study.from_content(result.study.content(), before / "study.toml")
    replace(result, study=here).save(before / "out")
    assert Result.load(before / "out").study.path == before / "study.toml"
    copytree(before, after)
    assert Result.load(after / "out").study.path == after / "study.toml"
    copytree(before / "out", tmp_path / "alone" / "out")
    assert Result.load(tmp_path / "alone" / "out").study.path == before / "study.toml"


def test_what_is_saved_is_what_is_loaded(result, folder):
    loaded = Result.load(folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted([*FILES, SIGNATURES])
    assert loaded.content() == result.content()
    assert loaded.materials == result.materials
    assert loaded.intervals == result.intervals
    assert loaded.study.digest() == result.study.digest()
    # A column of whole numbers, such as out_of_sight, has no decimal point in the file.
    pd.testing.assert_frame_equal(loaded.links, result.links, rtol=1e-5, check_dtype=False)
    pd.testing.assert_frame_equal(loaded.history, result.history, rtol=1e-8)
    assert len(loaded.history) == result.rt_calls


def test_the_file_is_strict_json(folder):
    def refuse(constant: str) -> None:
        raise ValueError(constant)

    content = json.loads((folder / "result.json").read_text(), parse_constant=refuse)
    assert content["version"] == 1
    assert content["fit"]["parameters"].keys() == planted.TRUTH.keys()


def test_prediction_at_the_measured_links_is_what_was_fitted(result, folder):
    fitted = result.links.after_db.to_numpy()
    for source in (result, Result.load(folder)):
        assert source.predict(result.study.measurements()) == pytest.approx(fitted, abs=1e-6)
    assert result.predict(planted.links()) == pytest.approx(fitted, abs=1e-6)
    assert result.links.before_db.to_numpy() != pytest.approx(fitted, abs=0.5)


def test_prediction_adds_the_offset_of_the_group(result):
    links = planted.links().iloc[[2, 2]].assign(half=["west", "east"])
    west, east = result.predict(links)
    assert east - west == pytest.approx(
        result.nuisance.offsets_db["east"] - result.nuisance.offsets_db["west"]
    )
    assert east - west > 5


def test_the_fallback_predicts_where_no_path_leads(result):
    links = planted.links(blocked=True)
    assert np.isfinite(result.predict(links)).all()
    without = replace(result, prediction=replace(result.prediction, fallback=None))
    assert np.flatnonzero(np.isinf(without.predict(links))).tolist() == [planted.INSIDE]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda links: links.assign(half="north"),
            "group 'north' has no calibrated offset; the calibrated groups are east, west; to use the mean for "
            "new groups, request an interval \\(--level",
        ),
        (lambda links: links.drop(columns="half"), "no column 'half'"),
        (lambda links: links.drop(columns="rx_z"), "no column 'rx_z'"),
        (lambda links: links.assign(rx_y=np.nan), "rx_y"),
        (lambda links: links.iloc[:0], "no rows"),
    ],
)
def test_links_that_cannot_be_predicted_are_refused(result, change, message):
    with pytest.raises(InputError, match=message):
        result.predict(change(planted.links()))


def test_the_scene_written_is_the_calibrated_one(result, folder):
    scene = read_scene(folder / "result-scene.xml", result.study.scene.frequency)
    original = read_scene(result.study.scene_source, result.study.scene.frequency)
    written = {entry.name: scene.materials[entry.material] for entry in scene.objects}
    assert written == {entry.name: result.materials[entry.material] for entry in original.objects}
    changed = {
        entry.material
        for entry in original.objects
        if written[entry.name] != original.materials[entry.material]
    }
    assert changed == {"concrete", "marble", "wood"}


@pytest.mark.parametrize("failing", FILES)
def test_a_file_that_could_not_be_written_leaves_nothing_half_written(result, tmp_path, failing):
    (tmp_path / failing / "in the way").mkdir(parents=True)
    with pytest.raises(InputError, match=f"output file {tmp_path / failing}: is a folder"):
        result.save(tmp_path)
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".part"] == []


def test_a_crash_while_saving_leaves_the_older_files(result, folder, monkeypatch):
    before = {path.name: path.read_text() for path in folder.iterdir()}

    def crash(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(pd.DataFrame, "to_csv", crash)
    with pytest.raises(KeyboardInterrupt):
        result.save(folder)
    assert {path.name: path.read_text() for path in folder.iterdir()} == before


def test_the_file_of_a_result_is_refused_with_the_remedy(folder):
    with pytest.raises(InputError, match=r"result\.json: is a file; give its folder"):
        Result.load(folder / "result.json")


def test_only_folders_with_a_result_are_loaded(folder, tmp_path):
    with pytest.raises(InputError, match="is not a result written by `calibray run`"):
        Result.load(tmp_path)
    text = (folder / "result.json").read_text()
    (folder / "result.json").write_text(text[:100])
    with pytest.raises(InputError, match="is not a result"):
        Result.load(folder)
    (folder / "result.json").write_text(text.replace('"version": 1,', '"version": 99,', 1))
    with pytest.raises(InputError, match="version 99, but must have version 1; run the study again"):
        Result.load(folder)


def edited(folder, **changes):
    """The folder with values of its `result.json` replaced; keys are dotted, and "" takes one out."""
    file = folder / "result.json"
    content = json.loads(file.read_text())
    for path, value in changes.items():
        *tables, key = path.split("__")
        table = content
        for name in tables:
            table = table[name]
        if value == "":
            del table[key]
        else:
            table[key] = value
    file.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fit__materials": {}}, "materials: 'concrete' is missing"),
        ({"nuisance__coefficients": {}}, "nuisance.coefficients: must contain the terms"),
        ({"fit__rmse_db": float("nan")}, r"rmse_db = nan: must be a finite number"),
        ({"fit__rmse_db": "1.5"}, r"rmse_db = '1.5': must be a number"),
        ({"fit__rmse_db": -1.0}, r"rmse_db = -1.0: must be at least 0"),
        ({"fit__rmse_db": ""}, "rmse_db: is required"),
        ({"surprise": 1}, "surprise: unknown key"),
        ({"fit__parameters": {}}, "parameters: '.*' is missing"),
        (
            {"fit__parameters__marble.relative_permittivity": 99.0},
            "materials.marble.relative_permittivity = ",
        ),
        ({"fit__materials__marble__thickness": -1.0}, "thickness"),
        ({"fit__materials__marble__thickness": float("inf")}, "thickness"),
        ({"nuisance__coefficients__offset__west": 1e9}, "offset: 1e\\+09 dB is outside -500 to 500"),
        ({"nuisance__coefficients__offset__west": None}, "offset.west = None: must be a number"),
        (
            {
                "uncertainty__intervals__iron.thickness": {
                    "standard_error": 1,
                    "lower": 1,
                    "upper": 2,
                    "verdict": "at bound",
                }
            },
            "iron",
        ),
        (
            {
                "uncertainty__intervals__iron.thickness": {
                    "standard_error": 1,
                    "lower": 1,
                    "upper": 2,
                    "verdict": "x",
                }
            },
            "verdict = 'x'",
        ),
        ({"version": 2}, "has version 2, but must have version 1"),
        ({"study__version": 7}, "study files of version 1"),
    ],
)
def test_a_damaged_result_is_refused(folder, changes, message):
    with pytest.raises(InputError, match=message) as refusal:
        Result.load(edited(folder, **changes))
    assert "result.json" in str(refusal.value) or "study.toml" in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("result-links.csv", "measured_db", "measured", "no column 'measured_db'"),
        ("result-links.csv", "True", "maybe", "column 'has_path' has values of the wrong type"),
        ("result-history.csv", "\n1,", "\nx,", "column 'call' has values of the wrong type"),
        ("result-history.csv", "\n1,1,", "\n1,1,,,\n1,1,", "not finite|something else"),
    ],
)
def test_a_damaged_table_of_a_result_is_refused(folder, name, old, new, message):
    file = folder / name
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        Result.load(folder)


def test_a_scene_that_changed_since_is_noticed_before_anything_is_predicted(tmp_path):
    scene = write_scene(tmp_path, {"floor": [[(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)]]})
    links = planted.links().head(6).assign(path_loss_db=80.0)
    content = planted.content("links.csv", parameters={"stone.relative_permittivity": {"bounds": [1.5, 12]}})
    content["scene"] = {"file": scene.name, "frequency": 3.5e9}
    content["trace"] = {"max_depth": 1, "samples": 1000}
    links.to_csv(tmp_path / "links.csv", index=False)
    result = calibrate(Study.from_content(content, tmp_path / "study.toml"), out=tmp_path / "out")
    loaded = Result.load(tmp_path / "out")
    assert loaded.predict(links) == pytest.approx(result.predict(links))
    mesh = next(tmp_path.rglob("*.ply"))
    scene.write_text(scene.read_text() + "\n<!-- moved -->\n")
    with pytest.raises(
        InputError, match=rf"{scene.name} changed since the calibration.*--allow-changed-inputs"
    ):
        loaded.predict(links)
    assert loaded.predict(links, allow_changed_inputs=True) == pytest.approx(
        result.predict(links, allow_changed_inputs=True)
    )
    mesh.write_bytes(mesh.read_bytes().replace(b"comment", b"Comment") + b" ")
    with pytest.raises(InputError, match=mesh.name):
        loaded.predict(links)


def test_a_result_never_takes_the_place_of_the_users_files(result, tmp_path):
    mine = tmp_path / "result-links.csv"
    mine.write_text("mine\n")
    with pytest.raises(InputError, match=r"result-links\.csv: was not written by Calibray.*--overwrite"):
        result.save(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["result-links.csv"]
    assert mine.read_text() == "mine\n"
    result.save(tmp_path, overwrite=True)
    result.save(tmp_path)
    assert Result.load(tmp_path).rmse_db == result.rmse_db
    # Into the study's own folder its files are left alone.
    home = result.study.path.parent
    before = (home / "links.csv").read_bytes()
    result.save(home)
    assert (home / "links.csv").read_bytes() == before


@pytest.mark.parametrize("written", [0, 1, 2, 3])
def test_a_run_killed_between_two_files_leaves_no_mixture(result, folder, monkeypatch, written):
    """Files are written in the order scene, links, history, result.json; the scene is the same in both runs."""
    links = result.links.assign(measured_db=result.links.measured_db + 1, after_db=result.links.after_db + 3)
    second = replace(result, links=links, history=result.history.assign(seconds=1.0))
    renamed, rename = [], Path.replace

    def rename_or_die(self, target):
        if len(renamed) == written:
            raise KeyboardInterrupt
        renamed.append(target)
        return rename(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", rename_or_die)
        with pytest.raises(KeyboardInterrupt):
            second.save(folder)
    if written < 2:
        assert Result.load(folder).links.measured_db.to_numpy() == pytest.approx(result.links.measured_db)
    else:
        for allow in (False, True):
            with pytest.raises(InputError, match=r"a different run from result\.json.*run the study again"):
                Result.load(folder, allow_changed_inputs=allow)
    second.save(folder)
    assert Result.load(folder).links.measured_db.to_numpy() == pytest.approx(links.measured_db)


def test_an_edited_table_is_refused_even_without_signatures(folder):
    (folder / SIGNATURES).unlink()
    file = folder / "result-links.csv"
    file.write_text(file.read_text().replace(",True,", ",False,", 1))
    with pytest.raises(
        InputError, match=r"has changed since result\.json was written.*--allow-changed-inputs"
    ):
        Result.load(folder)
    assert Result.load(folder, allow_changed_inputs=True) is not None


def test_a_validation_of_a_finished_result_changes_no_prediction_and_no_sentence_about_them(result):
    random, count = np.random.default_rng(4), len(result.links)
    rx = result.links[["rx_x", "rx_y", "rx_z"]].to_numpy()
    sizes = {Model.INITIAL: 1.0, Model.CALIBRATED: 5.0, Model.LOG_DISTANCE: 9.0}
    errors = {name: size * random.standard_normal(count) for name, size in sizes.items()}
    held_out = HeldOutErrors(
        ("1", "2"), np.arange(count) % 2, errors, rx, result.links["measured_db"].to_numpy()
    )
    validated = replace(result, held_out=held_out)
    links = planted.links()
    pd.testing.assert_frame_equal(validated.predict_interval(links), result.predict_interval(links))
    # The blocks would choose another model than the one that predicts.
    assert validated.validation.chosen == Model.INITIAL
    text = " ".join([*(part.text for part in summary(validated)), *map(str, validated.validation.summary())])
    assert "Predictions and maps use the model 'calibrated'" in text
    assert "predictions use the model 'initial materials'" not in text.lower()
    assert "'initial materials' is chosen, but predictions do not use this model yet" in text
    unjudged = replace(result.uncertainty, remarks=(Remark(RemarkKind.NOT_JUDGED),))
    assert NOT_JUDGED in replace(result, uncertainty=unjudged).remarks
    assert NOT_JUDGED not in replace(validated, uncertainty=unjudged).remarks


@pytest.mark.parametrize("command", ["report", "export", "predict", "suggest", "map"])
def test_every_command_that_reads_a_result_has_the_option_that_its_refusal_names(command):
    options = typer.main.get_command(app).commands[command].params
    assert "--allow-changed-inputs" in {name for option in options for name in option.opts}


def test_a_report_of_an_edited_result_is_written_with_the_option_that_its_refusal_names(folder):
    file = folder / "result-links.csv"
    file.write_text(file.read_text().replace(",True,", ",False,", 1))
    refused = CliRunner().invoke(app, ["report", str(folder)])
    assert (refused.exit_code, "--allow-changed-inputs" in refused.output) == (2, True)
    assert CliRunner().invoke(app, ["report", str(folder), "--allow-changed-inputs"]).exit_code == 0


def test_the_table_of_offsets_has_their_standard_deviations(result):
    """Planted offsets are within three of them, and they exceed those of known materials: 0.3 dB over the root of n."""
    table = nuisances(result)
    assert table.headings == ("Offsets", "[dB]", "standard deviation [dB]")
    assert [row[0] for row in table.rows] == sorted(OFFSETS)
    for half, value, deviation in table.rows:
        assert 0.3 / np.sqrt(6) < float(deviation) < 3.0
        assert abs(float(value) - OFFSETS[half]) < 3 * float(deviation)
    without = replace(result, uncertainty=replace(result.uncertainty, draws={}))
    assert nuisances(without).headings == ("Offsets", "[dB]")
