"""The export: plain Sionna RT, in a process of its own, gives the reported path loss; materials are as calibrated."""

from __future__ import annotations

import copy
import csv
import io
import json
import runpy
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import calibray as cb
import planted
import shown
from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.errors import InputError
from calibray.materials import Material
from calibray.reporting.export import FILES, _rows, export, matlab
from calibray.reporting.page import collect
from calibray.reporting.wording import sampling_text
from calibray.scenes import export_scene, read_scene
from calibray.tracing.protocol import LinkPositions
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from calibray.tracing.sionna.live_scene import verify_export
from changed import changed
from small_scenes import block, write_scene

pytestmark = pytest.mark.usefixtures("own_cache")

LIMIT_DB = 0.05


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study calibrated on the street canyon, with an offset per half and dipoles, and its result in `out`."""
    target = tmp_path_factory.mktemp("study")
    table = planted.campaign(noise_db=0.3, blocked=True)
    study = planted.study(
        target,
        table.assign(path_loss_db=table.path_loss_db.where(np.isfinite(table.path_loss_db), 110.0)),
        offset={"per": "half"},
        antennas={"tx": {"pattern": "dipole", "polarization": "V", "orientation": [0.0, 0.2, 0.0]}},
        method={"name": "auto", "options": {"starts": 4, "iterations": 10}},
    )
    cb.calibrate(study, out=target / "out")
    return target


def test_plain_sionna_gives_the_reported_path_loss(folder, tmp_path):
    """One receiver at a time, from a folder that was moved away with its meshes."""
    done = CliRunner().invoke(app, ["export", str(folder / "out"), "-o", str(tmp_path / "here"), "--copy"])
    assert (done.exit_code, done.stdout) == (0, ""), done.output
    shutil.move(tmp_path / "here", tmp_path / "there")
    ran = subprocess.run(
        [sys.executable, tmp_path / "there" / "load_scene.py"], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    rows = list(csv.DictReader(io.StringIO(ran.stdout)))
    links = Result.load(folder / "out").links
    assert [int(row["row"]) for row in rows] == links.row.tolist()
    computed = np.array([float(row["computed_db"]) for row in rows])
    assert np.isinf(computed).tolist() == (~links.has_path).tolist()
    reached = np.isfinite(computed)
    assert reached.sum() == len(links) - 1
    assert computed[reached] == pytest.approx(links.predicted_db[reached].to_numpy(), abs=LIMIT_DB)
    # Nor would the scene before calibration, or one without offsets, have done.
    assert np.abs(computed[reached] - links.before_db[reached].to_numpy()).max() > 10 * LIMIT_DB
    assert "calibray" not in (tmp_path / "there" / "load_scene.py").read_text().replace("Calibray", "")


def test_the_reported_path_loss_is_that_of_paths_sampled_with_the_calibrated_materials(
    tmp_path, monkeypatch, capsys
):
    """Few rays through walls: which paths are found depends on the materials of the trace."""
    study = planted.study(
        tmp_path,
        planted.campaign(),
        trace={"max_depth": 3, "samples": 200, "line_of_sight": False, "refraction": True},
        method={"name": "auto", "options": {"starts": 2, "iterations": 5}},
        fidelity={"rounds": 1},
    )
    result = cb.calibrate(study)
    links = result.links
    with np.errstate(invalid="ignore"):  # of links without a path
        gap = np.abs(links.predicted_db - links.after_db)
    assert gap[np.isfinite(gap)].max() > 5 * LIMIT_DB
    export(result, tmp_path / "exported")
    monkeypatch.setattr(sys, "argv", ["load_scene.py"])
    runpy.run_path(str(tmp_path / "exported" / "load_scene.py"), run_name="__main__")
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    computed = np.array([float(row["computed_db"]) for row in rows])
    assert computed == pytest.approx(links.scene_db.to_numpy(), abs=LIMIT_DB)
    assert np.isfinite(computed).sum() > len(links) / 2
    script = str(tmp_path / "exported" / "load_scene.py")
    monkeypatch.setattr(sys, "argv", ["load_scene.py", rows[0]["row"], "9999"])
    with pytest.raises(SystemExit, match=r"links\.csv has no row 9999"):
        runpy.run_path(script, run_name="__main__")
    record = tmp_path / "exported" / "calibration.json"
    calibration = json.loads(record.read_text())
    calibration["antennas"]["tx"]["pattern"] = "sector.msi"
    record.write_text(json.dumps(calibration))
    monkeypatch.setattr(sys, "argv", ["load_scene.py", rows[0]["row"]])
    with pytest.raises(SystemExit, match=r"The gain of the tx antenna is a table \(sector\.msi\)"):
        runpy.run_path(script, run_name="__main__")
    assert sampling_text(result) == ""
    unchecked = replace(result, fit=replace(result.fit, retrace_gap_db=None))
    assert "depends on the materials" in sampling_text(unchecked)
    assert sampling_text(unchecked).endswith("load_scene.py prints the difference for every link.")
    for section, stated in (
        ("links", {"tx_antenna": {"azimuth_deg": 0.0}}),
        ("antennas", {"tx": {"pattern": "sector.msi"}}),
    ):
        content = unchecked.study.content()
        content[section] |= stated
        other = replace(unchecked, study=cb.Study.from_content(content, result.study.path))
        assert "load_scene.py prints no differences" in sampling_text(other)


def test_a_scene_that_changed_since_the_calibration_is_not_exported_or_shown(folder, tmp_path):
    result = Result.load(folder / "out")
    other = changed(result, files={name: "0" * 64 for name in result.provenance.files})
    with pytest.raises(
        InputError, match=r"changed since the calibration, so the exported scene would not be"
    ):
        export(other, tmp_path / "exported")
    assert not (tmp_path / "exported").exists()
    assert export(other, tmp_path / "exported", allow_changed_inputs=True) == FILES
    (missing,) = [text for text in collect(other).missing if text.startswith("Paths")]
    assert "changed since the calibration" in missing


def test_tables_hold_the_calibrated_constants_and_intervals(folder, tmp_path):
    result = Result.load(folder / "out")
    assert export(result, tmp_path) == FILES
    assert all((tmp_path / name).is_file() for name in FILES)
    table = pd.read_csv(tmp_path / "materials.csv").set_index("material")
    content = json.loads((tmp_path / "materials.json").read_text())
    for name, value in result.parameters.items():
        material, _, constant = name.rpartition(".")
        assert table.loc[material, constant] == pytest.approx(value)
        interval = result.intervals[name]
        assert table.loc[material, f"{constant}_lower"] == pytest.approx(interval.lower)
        assert content[material][f"{constant}_upper"] == pytest.approx(interval.upper)
        assert content[material][f"{constant}_verdict"] == interval.verdict
    scene = read_scene(tmp_path / "scene.xml", result.study.scene.frequency)
    assert scene.materials[table.loc["wood", "scene_name"]] == result.materials["wood"]


def test_tables_of_materials_have_no_columns_of_antennas():
    result = shown.result()
    turned = changed(result, parameters={**result.parameters, "tx:mast.azimuth": 3.0})
    assert [list(row) for row in _rows(turned)] == [list(row) for row in _rows(result)]


def test_coefficients_over_frequency_are_exported(folder, tmp_path):
    law = {"itu_a": 5.1, "itu_b": 0.1, "itu_c": 0.02, "itu_d": 0.9}
    export(changed(Result.load(folder / "out"), laws={"wood": law}), tmp_path)
    content = json.loads((tmp_path / "materials.json").read_text())
    assert {name: content["wood"][name] for name in law} == law
    assert "itu_a" not in content["marble"]


def test_exported_coefficients_are_those_of_the_prediction_model():
    result = changed(shown.result(), laws={"wood": {"itu_a": 5.1, "itu_b": 0.1}})
    model = replace(result.prediction.model, parameters={"wood.itu_a": 4.2})
    chosen = replace(result, prediction=replace(result.prediction, model=model))
    assert chosen.scene_laws == {"wood": {"itu_a": 4.2, "itu_b": 0.1}}
    assert changed(chosen, parameters=None).scene_laws == result.fit.laws


@pytest.mark.skipif(shutil.which("octave-cli") is None, reason="needs octave-cli")
def test_octave_reads_the_materials(tmp_path):
    names = ["it's", 'a "b" % c', "nan\nbanana"]
    table = pd.DataFrame({"material": names, "relative_permittivity": [2.5, np.nan, 4.0]})
    (tmp_path / "materials.m").write_text(matlab(table, 3.5e9))
    code = "T = materials; printf('%s|', T.material{:}); printf('%g,', T.relative_permittivity);"
    ran = subprocess.run(
        ["octave-cli", "--norc", "--eval", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.stdout == 'it\'s|a "b" % c|nan\\nbanana|2.5,NaN,4,', ran.stderr


def test_meshes_of_one_name_are_kept_apart(tmp_path):
    scene = read_scene(
        write_scene(tmp_path, {"a": block((0, 0, 0), (1, 1, 1)), "b": block((2, 2, 0), (3, 3, 1))}), 3e9
    )
    (tmp_path / "more").mkdir()
    shutil.move(tmp_path / "meshes" / "b.ply", tmp_path / "more" / "a.ply")
    scene = replace(scene, xml=scene.xml.replace("meshes/b.ply", "more/a.ply"))
    (tmp_path / "out").mkdir()
    stone = {"stone": Material(5.0, 0.05, 0.2)}
    export_scene(scene, stone, tmp_path / "out" / "scene.xml", copy_meshes=True)
    copies = {path.name: path.read_text() for path in (tmp_path / "out" / "meshes").glob("*.ply")}
    assert copies == {
        "a.ply": (tmp_path / "meshes" / "a.ply").read_text(),
        "a-2.ply": (tmp_path / "more" / "a.ply").read_text(),
    }
    assert len(read_scene(tmp_path / "out" / "scene.xml", 3e9).objects) == 2


def test_files_of_others_are_not_replaced(folder, tmp_path):
    result = Result.load(folder / "out")
    (tmp_path / "links.csv").write_text("mine")
    with pytest.raises(InputError, match="was not written by Calibray"):
        export(result, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["links.csv"]
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(InputError, match="was not written by Calibray"):
        cb.report(result, tmp_path / "report.html")
    export(result, tmp_path, overwrite=True)
    export(result, tmp_path)


def test_a_folder_that_is_a_file_is_refused(folder, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file; name another folder"):
        export(Result.load(folder / "out"), tmp_path / "file")


NAMES = [
    "ground",
    "a.b",
    'say "so"',
    "back\\slash",
    "line\nbreak",
    "x" * 300,
    "itu.x",
    "mesh-ground",
    "dollar",
]


@pytest.mark.parametrize("name", NAMES)
def test_any_name_of_a_material_or_an_object_is_exported_as_one_that_sionna_loads(tmp_path, name):
    """An object named like a material is refused by Sionna RT, and a dot names a parameter of Mitsuba's."""
    file = write_scene(
        tmp_path / "in", {"ground": block((-9, -9, -1), (9, 9, 0)), "wall": block((3, -3, 0), (4, 3, 3))}
    )
    root = ElementTree.parse(file).getroot()
    material = copy.deepcopy(root.find("bsdf"))
    material.set("id", f"mat-{name}")
    material.find("float").set("value", "7.0")
    root.insert(0, material)
    wall, ground = root.findall("shape")[1], root.findall("shape")[0]
    ground.find("ref").set("id", f"mat-{name}")
    ground.set("id", f"mesh-{name}")
    wall.set("id", f"mesh-{name}.wall")
    ElementTree.ElementTree(root).write(file)
    scene = read_scene(file, 2e9)
    export_scene(scene, scene.materials, tmp_path / "out" / "scene.xml", copy_meshes=True)
    verify(scene, tmp_path / "out" / "scene.xml")


def verify(scene, target):
    links = LinkPositions(np.array([[0.0, 0, 2.0]]), np.array([[2.0, 1.0, 1.5]]))
    tracer = Tracer(scene, 2e9, TraceSettings(samples=10_000), Antenna(), Antenna())
    verify_export(tracer, scene.materials, target, links)


def test_an_export_that_sionna_loads_otherwise_is_refused(tmp_path):
    blocks = {"ground": block((-9, -9, -1), (9, 9, 0)), "wall": block((3, -3, 0), (4, 3, 3))}
    scene = read_scene(write_scene(tmp_path / "in", blocks), 2e9)
    target = tmp_path / "out.xml"
    export_scene(scene, scene.materials, target)
    verify(scene, target)
    sound = target.read_text()
    for old, new, message in (
        (
            '"relative_permittivity" value="5.0"',
            '"relative_permittivity" value="5.1"',
            "relative_permittivity of",
        ),
        ('id="mat-stone"', 'id="mat-brick"', "Sionna RT"),
        ("ground.ply", "missing.ply", "Sionna RT cannot load it"),
        ("</shape>", '<boolean name="flip_normals" value="maybe"/></shape>', "Sionna RT cannot load it"),
        (
            "</shape>",
            '<transform name="to_world"><scale value="2"/></transform></shape>',
            "contains a different surface of material 'stone'",
        ),
        # The same bounds and area, with the wall on the other side.
        (
            "</shape>",
            '<transform name="to_world"><scale x="-1"/></transform></shape>',
            "path loss differs",
        ),
    ):
        assert old in sound
        target.write_text(sound.replace(old, new))
        with pytest.raises(InputError, match=f"differs from the calibrated scene: .*{message}"):
            verify(scene, target)
