"""`calibray scene` and `calibray doctor` on scenes: output and refused input."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from calibray.cli.app import Commands
from calibray.cli.app import app as calibray
from calibray.cli.scene import scene
from calibray.reporting import scene_tables as report
from calibray.scenes import read_frame, read_scene
from calibray.scenes.checks import check_scene
from calibray.tables import render
from planted_maps import FRAME, write_extract

SQUARE = [(0, 0), (20, 0), (20, 20), (0, 20)]

app = typer.Typer(cls=Commands, pretty_exceptions_enable=False)
app.add_typer(scene)


def scene_command(*words: object) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of a command."""
    result = CliRunner().invoke(app, ["scene", *map(str, words)])
    return result.exit_code, result.stdout, result.stderr


def test_an_extract_becomes_a_scene(tmp_path):
    extract = write_extract(
        tmp_path / "town.osm",
        [
            (SQUARE, {"building": "yes", "height": "12"}),
            ([(x + 20, y) for x, y in SQUARE], {"building": "yes"}),
        ],
    )
    folder = tmp_path / "scene"
    status, out, err = scene_command(
        "osm", extract, "--out", folder, "--wall", "brick:0.24", "--roof", "wall", "--window-share", 0.3,
        "--origin", "11.5755,48.1374", "--utm", "--default-height", 7,
    )  # fmt: skip
    assert (status, err.strip()) == (0, "Making a scene with 2 buildings")
    assert "1 building: way-2" in out
    assert "EPSG:32632" in out
    materials = read_scene(folder / "scene.xml", 3.5e9).materials
    assert list(materials) == ["walls", "windows", "ground"]
    assert materials["walls"].thickness == 0.24
    assert read_frame(folder / "scene.xml").crs == "EPSG:32632"


def test_a_plan_becomes_a_scene(tmp_path):
    plan = tmp_path / "plan.csv"
    plan.write_text("x0,y0,x1,y1,type\n0,0,5000,0,drywall\n5000,0,5000,4000,brick\n5000,4000,0,0,brick\n")
    status, out, _ = scene_command(
        "plan", plan, "-o", tmp_path / "flat", "--unit", 0.001, "--material", "drywall=plasterboard:0.1",
        "--no-ceiling",
    )  # fmt: skip
    assert status == 0
    assert "5 m x 4 m" in out
    assert set(read_scene(tmp_path / "flat" / "scene.xml", 3.5e9).materials) == {
        "brick_wall",
        "drywall",
        "floor",
    }


def test_the_remedy_for_types_without_a_material_works_as_printed(tmp_path):
    plan = tmp_path / "plan.csv"
    text = "x0;y0;x1;y1;type\n0;0;5,5;0;T\u00fcr\n5,5;0;5,5;4;Mauer 2\n5,5;4;0;0;concrete\n"
    plan.write_text(text, encoding="utf-8")
    status, _, err = scene_command("plan", plan, "-o", tmp_path / "flat")
    assert status == 2
    words = shlex.split(re.search(r"as in (.*); or correct the type", err)[1])
    status, out, _ = scene_command(
        "plan", plan, "-o", tmp_path / "flat", *words, "--material", "concrete=brick"
    )
    assert (status, "lines      3" in out) == (0, True)
    materials = read_scene(tmp_path / "flat" / "scene.xml", 3.5e9).materials
    assert {"tur", "mauer_2", "concrete_wall"} < set(materials)


@pytest.mark.parametrize("target", ["scene.xml", "scene.json", "meshes/all-floor.ply", "meshes"])
def test_a_scene_replaces_only_files_of_calibray(tmp_path, target):
    plan, out = tmp_path / "plan.csv", tmp_path / "flat"
    plan.write_text("x0,y0,x1,y1,type\n0,0,5,0,wall\n5,0,5,4,wall\n5,4,0,4,wall\n0,4,0,0,wall\n")
    foreign = out / target
    foreign.parent.mkdir(parents=True, exist_ok=True)
    if target == "meshes":
        (tmp_path / "elsewhere").mkdir()
        foreign.symlink_to(tmp_path / "elsewhere")
    else:
        foreign.write_text("years of work")
    status, _, err = scene_command("plan", plan, "-o", out)
    assert status == 2
    assert "is a symbolic link" in err if target == "meshes" else "give --overwrite" in err
    assert not any((tmp_path / "elsewhere").iterdir()) if target == "meshes" else True
    written = [entry for entry in out.rglob("*") if entry.is_file()]
    assert written == ([] if target == "meshes" else [foreign])
    if target == "meshes":
        foreign.unlink()
    else:
        assert foreign.read_text() == "years of work"
    for words in (["--overwrite"], []):  # the second time all files are Calibray's
        assert scene_command("plan", plan, "-o", out, *words)[0] == 0


def test_a_scene_never_replaces_its_input(tmp_path):
    plan = tmp_path / "scene.xml"
    plan.write_text("x0,y0,x1,y1,type\n0,0,5,0,wall\n5,0,5,4,wall\n5,4,0,0,wall\n")
    before = plan.read_bytes()
    extract = write_extract(tmp_path / "scene.osm", [(SQUARE, {"building": "yes"})])
    (tmp_path / "scene.json").hardlink_to(extract)
    for words in (["plan", plan], ["osm", extract], ["footprints", extract, "--height", 8]):
        status, _, err = scene_command(*words, "-o", tmp_path, "--overwrite")
        assert (status, "is an input" in err) == (2, True)
    assert plan.read_bytes() == before


def write_town(path: Path, *properties: dict, move: tuple[float, float] = (0.0, 0.0)) -> Path:
    """One square for each set of properties, the last one moved [deg], as GeoJSON."""
    corners = FRAME.to_geographic([(*corner, 0) for corner in [*SQUARE, SQUARE[0]]])[:, :2]
    features = []
    for number, record in enumerate(properties):
        last = number == len(properties) - 1
        ring = (corners + [0.001 * number, 0] + np.array(move) * last).tolist()
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": record, "geometry": geometry})
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


@pytest.mark.parametrize(
    ("words", "move", "message"),
    [
        (["--margin", "nan"], (0, 0), "margin = nan: must be 0 to 50000 m"),
        (["--margin", "inf"], (0, 0), "margin = inf: must be"),
        (["--margin", "-1000"], (0, 0), "margin = -1000.0: must be"),
        ([], (-11.576, -48.137), r"building 'Hut' lies [\d,]+ km from the others"),
        ([], (-191.5, 0), r"building 'Hut' .*(180 degrees|km from the others)"),
        (
            ["--origin", "48.1374,11.5755"],
            (0, 0),
            r"the buildings are [\d,]+ km from this origin; give longitude first",
        ),
        (
            ["--height", "tall"],
            (0, 0),
            r"polygon 2: tall = 1e\+12, but must be finite, not negative and at most 1000",
        ),
        (["--height", "1e300"], (0, 0), r"1e\+300 = 1e\+300, must be finite|at most 1000"),
        (["--height", "nan"], (0, 0), "at most 1000|must"),
        (["--wall", "brick:1e20"], (0, 0), r"thickness = 1e\+20: must be greater than 0 and at most 100 m"),
    ],
    ids=str,
)
def test_senseless_scenes_are_refused(tmp_path, words, move, message):
    town = write_town(
        tmp_path / "town.geojson", {"name": "Hall", "tall": 9.0}, {"name": "Hut", "tall": 1e12}, move=move
    )
    height = [] if "--height" in words else ["--height", 9]
    status, _, error = scene_command(
        "footprints", town, "-o", tmp_path / "out", "--name", "name", *height, *words
    )
    assert status == 2
    assert re.search(message, error.replace("\n", " "))
    assert not (tmp_path / "out" / "scene.xml").exists()


def test_a_column_whose_name_is_a_number_is_taken_with_a_warning(tmp_path, caplog):
    town = write_town(tmp_path / "town.geojson", {"2020": 12.0})
    status, out, _ = scene_command("footprints", town, "-o", tmp_path / "out", "--height", "2020")
    assert status == 0
    assert "0.0 m to 12.0 m high" in out
    assert "2020 is interpreted as the name of a column" in caplog.text


def test_footprints_become_a_scene(tmp_path):
    town = write_town(tmp_path / "town.geojson", {})
    status, out, _ = scene_command("footprints", town, "-o", tmp_path / "out", "--height", 8)
    assert status == 0
    assert "0.0 m to 8.0 m high" in out
    storeys = ("footprints", town, "-o", tmp_path / "storeys", "--levels", "levels")
    write_town(town, {"levels": 4})
    assert "0.0 m to 12.0 m high" in scene_command(*storeys)[1]
    status, _, err = scene_command(*storeys[:4])
    assert (status, "columns: levels" in err) == (2, True)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["osm", "nowhere.osm", "-o", "out"], "does not exist"),
        (["osm", "town.osm", "-o", "out", "--utm"], "--utm needs --origin"),
        (["osm", "town.osm", "-o", "out", "--origin", "48"], "must be longitude and latitude"),
        (["osm", "town.osm", "-o", "out", "--wall", "brik"], "did you mean 'brick'"),
        (["osm", "town.osm", "-o", "out", "--wall", "brick:thick"], "'thick' is not a thickness"),
        (["osm", "town.osm", "-o", "out", "--window-share", "30"], "window share = 30"),
        (["osm", "town.osm", "-o", "out", "--terrain", "dem.tif"], "dem.tif: does not exist"),
        (["osm", "town.osm", "-o", "town.osm/out"], "is a file; name another folder"),
        (["plan", "plan.csv", "-o", "out", "--material", "brick"], "must be TYPE=ITU"),
    ],
)
def test_bad_input_is_refused_with_one_message(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    write_extract(Path("town.osm"), [(SQUARE, {"building": "yes"})])
    status, out, err = scene_command(*words)
    assert (status, out) == (2, "")
    assert message in err
    assert not Path("out").exists()


def test_a_scene_is_checked(tmp_path):
    canyon = check_scene("sionna:simple_street_canyon")
    text = render(*report.findings(canyon), report.objects(canyon))
    assert "can be used" in text
    assert "12 of 12 faces with normals that point inward" in text
    assert "building_6" in text
    extract = write_extract(tmp_path / "town.osm", [(SQUARE, {"building": "yes"})])
    scene_command("osm", extract, "-o", tmp_path / "out")
    assert "Findings" not in render(*report.findings(check_scene(tmp_path / "out" / "scene.xml")))


def doctor_command(*words: object) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of `calibray doctor`."""
    result = CliRunner().invoke(calibray, ["doctor", *map(str, words)])
    return result.exit_code, result.stdout, result.stderr


def test_doctor_checks_scenes_and_studies(tmp_path):
    extract = write_extract(tmp_path / "town.osm", [(SQUARE, {"building": "yes", "height": "12"})])
    assert CliRunner().invoke(calibray, ["scene", "osm", str(extract), "-o", str(tmp_path)]).exit_code == 0
    status, out, _ = doctor_command(tmp_path / "scene.xml")
    assert status == 0
    assert "can be used" in out
    assert "Objects" in out
    (tmp_path / "links.csv").write_text("x,y,loss\n0,40,80\n30,30,90\n")
    (tmp_path / "study.toml").write_text(
        'version = 1\n[scene]\nfile = "scene.xml"\nfrequency = 4e9\n[links]\nfile = "links.csv"\n'
        'tx = [40.0, 0.0, 10.0]\nrx = ["x", "y", 1.5]\nvalue = "loss"\n'
        '[parameters]\n"walls.relative_permittivity" = { bounds = [1.5, 12.0] }\n'
    )
    picture = tmp_path / "antennas.png"
    assert doctor_command(tmp_path / "study.toml", "--plot", picture)[0] == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    status, _, err = doctor_command(tmp_path / "study.toml", "--plot", tmp_path / "links.csv")
    assert (status, "the suffix '.csv' is unknown" in err) == (2, True)
    assert doctor_command(tmp_path / "scene.xml", "--plot", picture)[0] == 2
    assert doctor_command("--plot", picture)[0] == 2


def test_doctor_fails_on_an_unusable_scene(tmp_path):
    """The negative control: a mesh with the name of a material, which Sionna RT refuses."""
    extract = write_extract(tmp_path / "town.osm", [(SQUARE, {"building": "yes", "height": "12"})])
    CliRunner().invoke(calibray, ["scene", "osm", str(extract), "-o", str(tmp_path)])
    file = tmp_path / "scene.xml"
    file.write_text(file.read_text().replace("mesh-all-walls", "mesh-walls"))
    status, out, _ = doctor_command(file)
    assert (status, "cannot be used" in out) == (1, True)
