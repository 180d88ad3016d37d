"""A small fixed part of the fuzz suite, what the suite once found, and the pure parsers under hypothesis."""

import json
from pathlib import Path
from random import Random

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import shown
from calibray.calibration.result import Result
from calibray.engines.ledger.database import LedgerEntry, read_entry
from calibray.errors import InputError
from calibray.measurements import read_measurements, read_table
from calibray.measurements.filters import evaluate
from calibray.reporting.export import export
from calibray.scenes import export_scene, read_mesh, read_scene
from calibray.study import Study
from calibray.study.toml_file import expand
from calibray.support.output_files import check_file, check_folder
from calibray.tracing import gain_table
from calibray.validation.validate import validate
from commands import run, write_wall_study
from fuzzing import accidents, geometry, inputs, stored, workbooks, world
from fuzzing.outcome import ALLOWED, Watch, judge

LIGHT = (
    inputs.study,
    inputs.row_filter,
    inputs.table,
    workbooks.workbook,
    geometry.mesh,
    geometry.antenna,
    accidents.polyline,
    accidents.terrain,
)
"""Kinds that need nothing calibrated; cases that trace or run are the benchmark's."""
SLOW = (HealthCheck.too_slow, HealthCheck.data_too_large)
"""Not failures: the machine is busy when the whole suite runs."""
FUZZ = settings(max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=SLOW)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    place = tmp_path_factory.mktemp("world")
    (place / "base").mkdir()
    world.write(place / "base")
    return world.World(place, place / "base", {})


@pytest.fixture
def light(monkeypatch):
    monkeypatch.setattr(inputs, "DEEP", 0.0)
    monkeypatch.setattr(geometry, "TRACED", 0.0)
    monkeypatch.setattr(workbooks, "SWOLLEN", tuple(each for each in workbooks.SWOLLEN if each[-1] < 10**5))
    monkeypatch.setattr(
        geometry, "_traced", lambda study, whole: lambda: len(Study.load(study).opened().scene.objects)
    )


def verdicts(kind, found, folder, numbers):
    """What comes of cases of one kind."""
    watch, told = Watch(str(folder)), []
    for number in numbers:
        place = folder / str(number)
        place.mkdir()
        case = kind(Random(f"{kind.__name__}/{number}"), found, place)
        told.append((number, case.note, judge(case, place, watch)))
    return told


@pytest.mark.parametrize("kind", LIGHT, ids=lambda kind: kind.__name__)
def test_hostile_input_is_refused_or_read_rightly(kind, found, tmp_path, light):
    told = verdicts(kind, found, tmp_path, range(40))
    assert [each for each in told if each[2].verdict not in ALLOWED] == []
    # Half of it is no input at all, and the other half shows that the suite does not only knock at closed doors.
    assert {each[2].verdict for each in told} >= {"refused"}


def test_the_same_number_is_the_same_case(found, tmp_path):
    def made(name):
        folder = tmp_path / name
        folder.mkdir()
        return inputs.study(Random("0/7"), found, folder).note, (folder / "study.toml").read_bytes()

    assert made("first") == made("second")


def test_a_check_that_was_taken_out_is_noticed(found, tmp_path, monkeypatch, light):
    """The suite itself is checked: without the range of gains, impossible gains pass, and it says so."""
    monkeypatch.setattr(gain_table, "RANGES", dict.fromkeys(gain_table.RANGES, (-np.inf, np.inf)))
    monkeypatch.setattr(gain_table, "LARGEST_EFFICIENCY", np.inf)
    told = verdicts(geometry.antenna, found, tmp_path, range(200))
    assert "silent" in {each[2].verdict for each in told}


# What the suite found, each once.


def test_a_value_that_fits_no_type_of_its_key_is_told(found, tmp_path):
    content = world.content()
    content["links"]["rx"] = [0.0, {"bounds": [1.0, 2.0]}, 1.5]
    with pytest.raises(InputError, match=r"links\.rx\[1\]"):
        Study.from_content(content, tmp_path / "study.toml")


@pytest.mark.parametrize("name", ["x" * 300, "a/" + "x" * 5000, "a\0b"])
def test_names_that_no_output_can_have(name, tmp_path):
    for check in (check_folder, check_file):
        with pytest.raises(InputError, match=r"output (file|folder)"):
            check(tmp_path / name)


def test_a_quote_that_is_never_closed(tmp_path):
    (tmp_path / "links.csv").write_text('x,y\n1,2\n3,"\n')
    with pytest.raises(InputError, match=r"links\.csv"):
        read_table(tmp_path / "links.csv")


def test_whatever_breaks_the_reading_of_parquet_is_told(tmp_path, monkeypatch):
    def break_off(*_, **__):
        raise KeyError("name")

    (tmp_path / "links.parquet").write_bytes(b"PAR1")
    monkeypatch.setattr(pd, "read_parquet", break_off)
    with pytest.raises(InputError, match=r"links\.parquet: the file is not a Parquet file"):
        read_table(tmp_path / "links.parquet")


def test_an_overlong_column_is_not_said_again(tmp_path):
    (tmp_path / "links.csv").write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match="no column") as refusal:
        read_table(tmp_path / "links.csv").column("y" * 100_000)
    assert len(str(refusal.value)) < 1000


def test_a_candidate_of_another_type_is_no_entry():
    entry = LedgerEntry(np.array([80.0]), 1.0)
    columns = (entry.blob, 1.0, "", entry.digest("p", b"c"), None)
    assert isinstance(read_entry("p", b"c", columns), LedgerEntry)
    assert read_entry("p", "inf", columns) == "a value of the wrong type"


def test_an_overlong_argument_is_not_said_again(tmp_path):
    ended = run("doctor", "y" * 100_000)
    assert ended.exit_code == 2
    assert len(ended.output) < 1000


@pytest.mark.parametrize("engine", ["", "nothing", "command"])
def test_the_demo_refuses_an_engine_before_it_traces(engine, tmp_path, monkeypatch):
    monkeypatch.setattr("calibray.engines.make", lambda *_, **__: pytest.fail("made an engine"))
    assert run("demo", "--engine", engine, "-o", tmp_path / "out").exit_code == 2


@pytest.mark.parametrize("arguments", [("--seeds", 10**9), ("--methods", "gwo@9999999999")])
def test_comparisons_without_end_are_refused(arguments, tmp_path):
    ended = run("compare", write_wall_study(tmp_path), "-o", tmp_path / "out", *arguments)
    assert ended.exit_code == 2, ended.output


def test_blocks_without_number_are_refused(found):
    with pytest.raises(InputError, match=r"blocks = 1000000000; must be a whole number from 2 to 100"):
        validate(Study.load(found.base / "study.toml"), blocks=10**9)


def test_an_edited_result_is_refused_unless_it_is_meant(tmp_path):
    source = Path(__file__).parent / "golden" / "result"
    for file in source.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    file = tmp_path / "result.json"
    world.sign(file)
    assert Result.load(tmp_path).rmse_db >= 0
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"fit": content["fit"] | {"rmse_db": 0.001}}))
    with pytest.raises(
        InputError, match=r"result\.json: has changed since Calibray wrote it.*--allow-changed-inputs"
    ):
        Result.load(tmp_path)
    assert Result.load(tmp_path, allow_changed_inputs=True).rmse_db == 0.001


def test_an_export_takes_no_place_of_the_users_files(found, tmp_path):
    (tmp_path / "links.csv").write_text("mine\n")
    with pytest.raises(InputError, match=r"links\.csv: was not written by Calibray"):
        export(shown.result(), tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == ["links.csv"]
    scene = read_scene(found.base / "scene.xml", 3.5e9)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "house.ply").write_text("mine\n")
    with pytest.raises(InputError, match=r"house\.ply: was not written by Calibray"):
        export_scene(scene, scene.materials, tmp_path / "scene.xml", copy_meshes=True)
    export_scene(scene, scene.materials, tmp_path / "scene.xml", copy_meshes=True, overwrite=True)
    assert (tmp_path / "meshes" / "house.ply").read_bytes() == (
        found.base / "meshes" / "house.ply"
    ).read_bytes()


def test_positions_of_a_result_that_are_no_numbers(tmp_path):
    source = Path(__file__).parent / "golden" / "result"
    for file in source.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    links = pd.read_csv(tmp_path / "result-links.csv")
    links.assign(rx_z="{'x': 1}").to_csv(tmp_path / "result-links.csv", index=False)
    with pytest.raises(InputError, match=r"result-links\.csv"):
        Result.load(tmp_path)


def test_a_fault_whose_words_hold_braces_is_told(tmp_path):
    source = Path(__file__).parent / "golden" / "result"
    for file in source.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    content = json.loads((tmp_path / "result.json").read_text())
    (tmp_path / "result.json").write_text(json.dumps(content | {"files": {"a.xml": "no digest"}}))
    with pytest.raises(InputError, match="files"):
        Result.load(tmp_path)


def outcome(parser, *arguments):
    """What a parser gives, and its refusal; one of the two is None."""
    try:
        return parser(*arguments), None
    except InputError as error:
        return None, str(error)


# The pure parsers: whatever they are given, an answer of the right form or one of the two refusals.

_words = st.lists(st.sampled_from(inputs._TOKENS), max_size=12).map(" ".join)


@FUZZ
@given(text=_words | st.text(max_size=60) | st.sampled_from(inputs.ESCAPES))
@example(text="x > 1e999")
def test_any_filter_gives_a_mask_or_is_refused(text):
    mask, refusal = outcome(evaluate, text, inputs.FRAME)
    if refusal is None:
        assert mask.dtype == bool
        assert mask.shape == (len(inputs.FRAME),)
    else:
        assert 0 < len(refusal) < 2000


@FUZZ
@given(text=st.text(alphabet="ab${}:-_ ", max_size=30))
def test_any_text_is_expanded_or_refused(text):
    expanded, refusal = outcome(expand, text, {"a": "1", "b": "2"})
    assert refusal or "${" not in expanded


_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@FUZZ
@given(section=st.sampled_from(sorted(world.content())), key=st.none() | st.text(max_size=6), value=_values)
def test_any_value_in_a_study_is_taken_or_refused(section, key, value):
    content = world.content()
    if key is None or not isinstance(content[section], dict):
        content[section] = value
    else:
        content[section] = content[section] | {key: value}
    study, refusal = outcome(Study.from_content, content)
    if refusal is None:
        assert Study.from_content(study.content()).digest() == study.digest()
    else:
        assert refusal.startswith("study.toml")


@FUZZ
@given(
    cells=st.lists(
        st.floats() | st.text(alphabet='0123456789.eE+-x ,"\n', max_size=8), min_size=1, max_size=5
    )
)
def test_any_cells_are_read_as_python_reads_them_or_refused(cells, tmp_path_factory):
    file = tmp_path_factory.mktemp("rows") / "links.csv"
    table = pd.DataFrame({"x": range(10, 10 + len(cells)), "loss": [str(cell) for cell in cells]})
    table.to_csv(file, index=False)
    links, refusal = outcome(read_measurements, file, [0.0, 0.0, 2.0], ["x", 0.0, 1.5], "loss")
    if refusal is None:
        # pandas ignores a space after the exponent's letter: "+1E 2" is 100.
        expected = [
            float(cell.replace("E ", "E").replace("e ", "e") if isinstance(cell, str) else cell)
            for cell in cells
        ]
        np.testing.assert_allclose(links.path_loss_db, expected, rtol=1e-12)
    else:
        assert "links.csv" in refusal


_header = st.lists(
    st.sampled_from(
        (
            "format ascii 1.0",
            "format binary_little_endian 1.0",
            "element vertex 3",
            "element face 1",
            "element vertex 99999999999",
            "element edge 2",
            "property float x",
            "property float y",
            "property float z",
            "property double x",
            "comment x",
            "property list uchar int vertex_indices",
            "property list int int vertex_index",
            "property list uchar float other",
            "",
        )
    ),
    max_size=10,
)


@FUZZ
@given(header=_header, body=st.binary(max_size=80))
def test_any_mesh_is_whole_or_refused(header, body, tmp_path_factory):
    file = tmp_path_factory.mktemp("meshes") / "mesh.ply"
    file.write_bytes("\n".join(["ply", *header, "end_header", ""]).encode() + body)
    _, refusal = outcome(read_mesh, file, "ply")
    assert refusal is None or "mesh.ply" in refusal


def test_kinds_of_what_calibray_wrote_are_attacked_too():
    """They need a calibration, which the benchmark makes; here it is only seen that they are among its kinds."""
    from fuzzing.kinds import SHARES

    assert set(stored.KINDS) <= set(SHARES)
