import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel

from calibray.errors import InputError
from calibray.materials import Material
from calibray.study import Study, expand
from calibray.tracing.settings import Antenna, TraceSettings

MINIMAL = """\
version = 1
[scene]
file = "scene.xml"
frequency = 4e9
[links]
file = "links.csv"
tx = [0.0, 0.0, 10.0]
rx = ["x", "y", 1.5]
value = "loss"
[parameters]
"walls.relative_permittivity" = { bounds = [1.5, 12.0] }
"""
FULL = """\
version = 1
[scene]
file = "scene.xml"
frequency = 4e9
bandwidth = 2e8
[materials]
walls = { itu = "concrete", revision = "P.2040-1", thickness = 0.3 }
soil = { relative_permittivity = 2.25, conductivity = 0.01, scattering_pattern = "directive", alpha_r = 4 }
[links]
file = "links.csv"
tx = [0.0, 0.0, 10.0]
rx = ["x", "y", 1.5]
value = "power"
quantity = "received_power"
where = "ok == 1"
std = "spread"
tx_power_dbm = 30
[antennas]
tx = { pattern = "dipole", polarization = "V", orientation = [0.1, 0, 0] }
[trace]
max_depth = 4
refraction = true
[objective]
combining = "band"
no_path = "censor"
ceiling_db = 150
[parameters]
"walls.relative_permittivity" = { bounds = [1.5, 12.0], start = "itu:concrete@P.2040-1" }
"soil.conductivity" = { bounds = [1e-4, 1], scale = "log" }
[offset]
per = "set"
bounds = [-10, 10]
[holdout]
where = "x > 25"
[method]
name = "gwo"
seed = 7
options = { population = 10 }
[engine]
name = "retrace"
"""
LINKS = """\
x,y,power,spread,ok,set
10,0,-50,2,1,A
20,0,-55,2,1,B
30,0,-60,4,1,B
40,0,-99,1,0,A
"""
BASE = {"walls": Material(5.31, 0.1, 0.3), "soil": Material(2.25, 0.01, 0.5)}
REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "scene.xml").write_text("<scene version='2.1.0'/>")
    (tmp_path / "links.csv").write_text(LINKS)
    return tmp_path


def load(folder, text=FULL):
    path = folder / "study.toml"
    path.write_text(text)
    return Study.load(path)


def refusal(folder, text):
    with pytest.raises(InputError) as error:
        load(folder, text)
    return str(error.value).replace(f"{folder}{os.sep}", "")


def test_every_section_is_read(folder):
    study = load(folder)
    assert study.scene_source == str(folder / "scene.xml")
    assert study.links_path == folder / "links.csv"
    assert (study.scene.frequency, study.scene.bandwidth) == (4e9, 2e8)
    assert study.overrides == {
        "walls": {"itu": "concrete", "revision": "P.2040-1", "thickness": 0.3},
        "soil": {
            "relative_permittivity": 2.25,
            "conductivity": 0.01,
            "scattering_pattern": "directive",
            "alpha_r": 4.0,
        },
    }
    assert isinstance(study.trace, TraceSettings)
    assert study.trace.record() == TraceSettings(max_depth=4, refraction=True).record()
    assert isinstance(study.antennas.tx, Antenna)
    assert (study.antennas.tx.pattern, study.antennas.tx.orientation) == ("dipole", (0.1, 0.0, 0.0))
    assert (study.antennas.rx.pattern, study.antennas.rx.polarization) == ("iso", "V")
    assert (study.objective.combining, study.objective.no_path, study.objective.ceiling_db) == (
        "band",
        "censor",
        150,
    )
    assert (study.offset.per, study.offset.bounds, study.holdout.where) == ("set", (-10, 10), "x > 25")
    assert (study.method.name, study.method.seed, study.method.options) == ("gwo", 7, {"population": 10})
    assert study.engine.name == "retrace"


def test_what_is_left_out_has_its_default(folder):
    study = load(folder, MINIMAL)
    assert study.trace.record() == TraceSettings().record()
    assert (study.objective.combining, study.objective.no_path) == ("power", "exclude")
    assert (study.method.name, study.method.seed, study.engine.name) == ("auto", 0, "replay")
    assert (study.offset, study.holdout, study.overrides) == (None, None, {})


def test_measurements_are_read_with_their_groups(folder):
    study = load(folder)
    links = study.measurements()
    assert links.path_loss_db.tolist() == [80, 85, 90]
    assert links.weight.tolist() == [1 / 4, 1 / 4, 1 / 16]
    assert links.group.tolist() == ["A", "B", "B"]
    assert study.held_out(links).tolist() == [False, False, True]
    assert not load(folder, MINIMAL).held_out(links).any()


def test_parameters_keep_the_order_of_the_file_and_resolve_their_starts(folder):
    parameters = load(folder).parameter_set(BASE)
    assert parameters.names == ("walls.relative_permittivity", "soil.conductivity")
    assert parameters.start.tolist() == [5.31, 0.01]
    assert parameters.logarithmic.tolist() == [False, True]


def test_what_only_the_scene_can_tell_is_refused_with_the_study_named(folder):
    study = load(folder)
    with pytest.raises(InputError, match=r"study\.toml: .*no material 'walls'; did you mean 'wall'"):
        study.parameter_set({"wall": BASE["walls"], "soil": BASE["soil"]})
    with pytest.raises(InputError, match=r"soil\.conductivity: start = 2 is outside bounds"):
        study.parameter_set(BASE | {"soil": Material(2.25, 2.0, 0.5)})


def test_bundled_scenes_need_no_file(folder):
    study = load(folder, MINIMAL.replace("scene.xml", "sionna:munich"))
    assert study.scene_source == "sionna:munich"


def test_environment_variables_expand_in_file_names(folder, monkeypatch):
    text = MINIMAL.replace('"links.csv"', '"${CALIBRAY_TEST_DATA:-data}/links.csv"')
    (folder / "data").mkdir()
    (folder / "data" / "links.csv").write_text(LINKS)
    monkeypatch.delenv("CALIBRAY_TEST_DATA", raising=False)
    assert load(folder, text).links_path == folder / "data" / "links.csv"
    monkeypatch.setenv("CALIBRAY_TEST_DATA", str(folder))
    assert load(folder, text).links_path == folder / "links.csv"
    monkeypatch.delenv("CALIBRAY_TEST_DATA")
    assert (
        "links.file = '${CALIBRAY_TEST_DATA}/links.csv': environment variable CALIBRAY_TEST_DATA is not set"
        in (refusal(folder, text.replace(":-data", "")))
    )


@pytest.mark.parametrize(
    ("text", "expanded"),
    [
        ("plain/$name{}.csv", "plain/$name{}.csv"),
        ("${A}/${B:-b}/${C:-}x", "a/b/x"),
        ("${EMPTY:-../../shared/data}", "../../shared/data"),
    ],
)
def test_expansion_of_variables(text, expanded):
    assert expand(text, {"A": "a", "EMPTY": ""}) == expanded


@pytest.mark.parametrize("text", ["${", "${A-b}", "${1A}", "${A:-${B}}"])
def test_malformed_variables_are_refused(text):
    with pytest.raises(InputError, match="malformed"):
        expand(text, {"A": "a", "B": "b"})


TRACE = "max_depth = 4"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        # Keys
        (TRACE, "max_dept = 4", "study.toml: trace.max_dept: unknown key; did you mean 'max_depth'?"),
        ("[holdout]", "[holdouts]", "study.toml: holdouts: unknown key; did you mean 'holdout'?"),
        ('polarization = "V"', 'polarisation = "V"', "polarisation: unknown key; did you mean"),
        ("bounds = [1.5", "bound = [1.5", ".bound: unknown key; did you mean 'bounds'"),
        ("thickness = 0.3", "thicknes = 0.3", "materials.walls.thicknes: unknown key; did you mean"),
        ('"walls.relative_permittivity"', "walls.relative_permittivity", 'quote the name, "walls.rel'),
        ("frequency = 4e9", "", "study.toml: scene.frequency: is required"),
        ("version = 1", "", "study.toml: version: is required"),
        # Values
        ("version = 1", "version = 2", "study.toml: version = 2: this version of Calibray reads only study files"),
        ("frequency = 4e9", "frequency = 4", "scene.frequency = 4: must be from 1e+06 to 1e+12 Hz"),
        ("frequency = 4e9", "frequency = '4e9'", "scene.frequency = '4e9': must be a number"),
        ("frequency = 4e9", "frequency = inf", "scene.frequency = inf: must be a finite number"),
        ("bandwidth = 2e8", "bandwidth = 0", "scene.bandwidth = 0: must be greater than 0"),
        (TRACE, "max_depth = -1", "study.toml: trace.max_depth = -1: must be a whole number from 0 to 100"),
        (TRACE, "max_depth = true", "trace.max_depth = True: must be a whole number"),
        ("[offset]", "[noise]\nheterogeneity = 3\n[offset]", "= 3: must be one of 'auto', or must be at most 2"),
        ("[offset]", "[noise]\nheterogeneity = 'a'\n[offset]", "must be one of 'auto', or must be a number"),
        (TRACE, "samples = 1.5", "trace.samples = 1.5: must be a whole number"),
        ("refraction = true", "refraction = 1", "trace.refraction = 1: must be true or false"),
        ('"dipole"', '"dipol"', "antennas.tx: antenna pattern = 'dipol': must be"),
        ("[0.0, 0.0, 10.0]", "[0.0, 10.0]", "links.tx[2]: is required"),
        ("[0.0, 0.0, 10.0]", "[0, 0, 0, 0]", "links.tx = [0, 0, 0, 0]: must have 3 entries, but has 4"),
        ("[0.0, 0.0, 10.0]", "[0, 0, true]", "links.tx[2] = True: must be a number"),
        ('"received_power"', '"power"', "links.quantity = 'power': must be one of 'path_"),
        ('combining = "band"', 'combining = "sum"', "objective.combining = 'sum': must be one of 'power', "),
        ("bandwidth = 2e8", "", "objective.combining = 'band' needs scene.bandwidth"),
        ("ceiling_db = 150", "", "objective: no_path = 'censor' needs ceiling_db"),
        ('"received_power"', '"rsrp"', "with links.quantity = 'rsrp': the largest path loss is unknown"),
        ('no_path = "censor"', "", "ceiling_db = 150 has no effect"),
        ("bounds = [-10, 10]", "bounds = [10, -10]", "offset.bounds = [10, -10]: the lower bound"),
        ("seed = 7", "seed = -7", "method.seed = -7: must be at least 0"),
        ('"retrace"', '"trace"', "engine.name = 'trace': must be one of 'command', "),
        # Physics
        ("ness = 0.3", "ness = 0", "materials.walls: thickness = 0.0: must be"),
        ('itu = "concrete", ', "", "materials.walls: revision = 'P.2040-1' without itu"),
        ('itu = "concrete"', 'itu = "concret"', "materials.walls: 'concret' is not a material of"),
        ('itu = "concrete"', 'itu = "floorboard"', "covers 'floorboard' at 50 to 100 GHz, not at 4"),
        ("[1.5, 12.0]", "[12.0, 1.5]", "bounds = [12.0, 1.5] are reversed"),
        ("[1.5, 12.0]", "[0.5, 12.0]", "walls.relative_permittivity: bounds = [0.5, 12.0]: 0.5 must be"),
        ("[1.5, 12.0]", "[1.5, 4.0]", "start = 5.31 is outside bounds = [1.5, 4]"),
        ("walls.relative_permittivity", "walls.permittivity", "no field 'permittivity'; did you mean"),
        ("itu:concrete@", "itu:concrte@", "start = 'itu:concrte@P.2040-1': 'concrte' is not a material"),
        ("itu:concrete@", "concrete@", "must be a number or 'itu:NAME'"),
        # Files
        ('"scene.xml"', '"nowhere.xml"', "scene.file = 'nowhere.xml': no such file, nowhere.xml"),
        ('"links.csv"', '"nowhere.csv"', "links.file = 'nowhere.csv': no such file, nowhere.csv"),
    ],
)  # fmt: skip
def test_faults_are_refused_with_file_key_value_and_bound(folder, old, new, message):
    assert FULL.count(old), "the case replaces nothing"
    assert message in refusal(folder, FULL.replace(old, new))


def test_a_value_in_place_of_a_table_and_a_table_without_entries(folder):
    assert refusal(folder, MINIMAL.replace("version = 1", "version = 1\nengine = 3")) == (
        "study.toml: engine = 3: must be a table"
    )
    no_parameters = MINIMAL[: MINIMAL.index('"walls')]
    assert "study.toml: parameters: none given" in refusal(folder, no_parameters)
    assert "study.toml: parameters: is required" in refusal(folder, no_parameters.replace("[parameters]", ""))


def test_the_file_of_every_case_is_sound_before_its_change(folder):
    assert load(folder).method.name == "gwo"  # the negative control of the test above


def test_all_faults_are_told_at_once_a_line_each(folder):
    text = FULL.replace(TRACE, "max_dept = 4\nsamples = '3'").replace("seed = 7", "seed = -7")
    assert refusal(folder, text).splitlines() == [
        "study.toml: trace.samples = '3': must be a whole number, or must be one of 'auto'",
        "study.toml: trace.max_dept: unknown key; did you mean 'max_depth'?",
        "study.toml: method.seed = -7: must be at least 0",
    ]


def test_files_that_are_no_study(folder):
    with pytest.raises(InputError, match=r"none\.toml: no such study file"):
        Study.load(folder / "none.toml")
    with pytest.raises(InputError, match="no such study file"):
        Study.load(folder)
    assert "study.toml: not valid TOML:" in (message := refusal(folder, "version = 1\n[scene\n"))
    assert "line 2" in message
    (folder / "study.toml").write_bytes(b"version = 1 # \xff")
    with pytest.raises(InputError, match="not UTF-8"):
        Study.load(folder / "study.toml")


def test_digest_tells_content_not_layout(folder):
    study = load(folder, MINIMAL)
    same = load(
        folder,
        "# a comment\n" + MINIMAL.replace("version = 1", "version   = 1") + "[engine]\nname = 'replay'\n",
    )
    assert study.digest() == same.digest()
    assert Study.from_content(study.content(), folder / "elsewhere.toml").digest() == study.digest()
    assert json.loads(json.dumps(study.content())) == study.content()
    swapped = MINIMAL + '"walls.thickness" = { bounds = [0.1, 0.5] }\n'
    first, second = swapped.splitlines(keepends=True)[-2:]
    others = [MINIMAL.replace("4e9", "5e9"), swapped, swapped.replace(first + second, second + first)]
    digests = {load(folder, text).digest() for text in others} | {study.digest()}
    assert len(digests) == 4


def test_replacing_method_seed_and_engine(folder):
    study = load(folder)
    changed = study.replace(method="auto", seed=3, engine="replay")
    assert (changed.method.name, changed.method.seed, changed.method.options) == ("auto", 3, {})
    assert (changed.engine.name, changed.path) == ("replay", study.path)
    assert study.replace(seed=3).method.options == {"population": 10}
    assert study.replace().digest() == study.digest()
    with pytest.raises(InputError, match=r"engine\.name = 'matlab'"):
        study.replace(engine="matlab")


def test_a_study_cannot_be_changed(folder):
    with pytest.raises(ValueError, match="frozen"):
        load(folder).method.seed = 3


def is_table(annotation):
    return is_dataclass(annotation) or (isinstance(annotation, type) and issubclass(annotation, BaseModel))


def keys(model, prefix=""):
    """The dotted keys of a model's leaves; NAME stands for a material, "NAME.FIELD" for a parameter."""
    if is_dataclass(model):
        names = {field.name: field.type for field in fields(model)}
    else:
        names = {name: field.annotation for name, field in model.model_fields.items()}
    for name, annotation in names.items():
        options = get_args(annotation) or (annotation,)
        # Several where a table is of one kind or another.
        tables = [o for o in options if is_table(o)]
        wild = {
            "materials": ".NAME",
            "parameters": '."NAME.FIELD"',
            "nuisance": ".NAME",
            "regions": ".NAME",
            "facades": ".NAME",
            "observables": ".NAME",
        }.get(name, "")
        inner = (key for table in tables for key in keys(table, f"{prefix}{name}{wild}."))
        yield from dict.fromkeys(inner) if tables else [f"{prefix}{name}"]


def test_the_reference_names_every_key_and_no_other():
    pages = (REPOSITORY / "docs" / "reference").glob("study-*.md")
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    documented = re.findall(r"^\| `([^`]+)` \|", text, flags=re.MULTILINE)
    assert sorted(documented) == sorted(keys(Study))


def test_the_reference_tells_the_defaults():
    text = (REPOSITORY / "docs" / "reference" / "study-file.md").read_text(encoding="utf-8")
    table = dict(re.findall(r"^\| `trace\.(\w+)` \| [^|]+ \| (\w+) \|", text, flags=re.MULTILINE))
    assert table == {name: str(value).lower() for name, value in TraceSettings().record().items()}


def test_the_example_of_the_reference_is_a_valid_study():
    text = (REPOSITORY / "docs" / "reference" / "study-file.md").read_text(encoding="utf-8")
    example = re.search(r"```toml\n(.*?)```", text, flags=re.DOTALL).group(1)
    assert Study.from_content(tomllib.loads(example)).scene.frequency == 28.5e9


def test_reading_a_study_imports_neither_tracer_nor_jax():
    script = "import calibray.study, sys; print(*{'jax', 'sionna', 'mitsuba', 'drjit'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""


# Settings of methods


def options_of(folder, method, options):
    text = FULL.replace('name = "gwo"', f'name = "{method}"').replace("{ population = 10 }", options)
    return load(folder, text).method.options


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("gwo", "{ population = 12, iterations = 9 }"),
        ("sgwo-im", "{ w_min = 0.2, w_max = 1, convergence = 'linear', surrogate = false }"),
        ("vector-surrogate", "{ budget = 50, noisy = true }"),
        ("least-squares", "{ starts = 4, x0 = [[1.0, 2], [3, 4.5]] }"),
        ("auto", "{ anything = 3 }"),
    ],
)
def test_settings_of_methods_are_read(folder, method, options):
    assert options_of(folder, method, options) == tomllib.loads(f"options = {options}")["options"]


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("gwo", "{ wolves = 3 }", "wolves: the method 'gwo' has no such setting; use one of: "),
        ("gwo", "{ populatoin = 3 }", "the method 'gwo' has no such setting; did you mean 'population'?"),
        ("gwo", "{ seed = 3 }", "seed: the method 'gwo' has no such setting"),
        ("gwo", "{ lower = [3] }", "lower: the method 'gwo' has no such setting"),
        ("space-mapping", "{ cheap_model = 3 }", "use one of: budget, batch, noisy"),
        ("sgwo-im", "{ surrogate = 'x' }", "surrogate = 'x': must be true or false"),
        ("sgwo-im", "{ surrogate = 1 }", "surrogate = 1: must be true or false"),
        ("gwo", "{ population = '9' }", "population = '9': must be a whole number"),
        ("gwo", "{ population = true }", "population = True: must be a whole number"),
        ("gwo", "{ population = 9.5 }", "population = 9.5: must be a whole number"),
        ("gwo", "{ population = nan }", "population = nan: must be a finite number"),
        ("gwo", "{ population = 10000000 }", "population = 10000000: must be at most 1,000,000"),
        ("gwo", "{ population = -9999999999999999 }", "must be at most 1,000,000"),
        ("gwo", "{ population = { a = 1 } }", "must be a number, text, true, false, or a list of these"),
        ("gwo", "{ population = 2024-01-01 }", "must be a whole number"),
        ("sgwo-im", "{ w_min = nan }", "w_min = nan: must be a finite number"),
        ("sgwo-im", "{ w_max = -inf }", "w_max = -inf: must be a finite number"),
        ("sgwo-im", "{ w_max = true }", "w_max = True: must be a number"),
        ("sgwo-im", "{ convergence = 3 }", "convergence = 3: must be text in quotes"),
        ("least-squares", "{ x0 = [1.0, nan] }", "must be a finite number"),
        ("least-squares", "{ x0 = [[[[1.0]]]] }", "must be a list of at most"),
        ("auto", "{ anything = inf }", "anything = inf: must be a finite number"),
        ("auto", "{ anything = '" + "a" * 20_000 + "' }", "...aaaaaaa"),
    ],
)
def test_settings_that_no_method_takes(folder, method, options, message):
    with pytest.raises(InputError) as caught:
        options_of(folder, method, options)
    text = str(caught.value)
    assert "study.toml: method.options." in text
    assert message in text
    assert "\n" not in text
    assert len(text) < 600


# Sizes


def many(count, content):
    """A study of many materials with some parameters each."""
    return {
        "version": 1,
        "scene": {"file": "s.xml", "frequency": 3.5e9},
        "links": {"file": "l.csv", "tx": [0, 0, 1], "rx": ["x", "y", 1], "value": "v"},
        "parameters": {f"wall-{k}.{field}": entry for k in range(count) for field, entry in content.items()},
    }


def test_ten_thousand_parameters_and_no_more():
    """Quadratic loops took minutes."""
    constant = {"relative_permittivity": {"bounds": [1.5, 12.0]}}
    laws = {"itu_a": {"bounds": [2.0, 6.0], "start": 3.0}, "itu_b": {"bounds": [-0.1, 0.1], "start": 0.0}}
    base = {f"wall-{k}": Material(5.0, 0.1, 0.3) for k in range(10_000)}
    for count, content in ((10_000, constant), (5_000, laws)):
        parameters = Study.from_content(many(count, content)).parameter_set(base)
        assert len(parameters) == 10_000
        changed = parameters.materials(parameters.lower, base)
        assert changed["wall-4999"].relative_permittivity < 5.0
    with pytest.raises(InputError, match="parameters: 10001, must be at most 10000"):
        Study.from_content(many(10_001, constant))


def test_many_and_long_faults_make_a_short_message():
    content = many(500, {"relative_permittivity": {"bounds": "b" * 5000}})
    with pytest.raises(InputError) as caught:
        Study.from_content(content)
    lines = str(caught.value).splitlines()
    assert len(lines) == 21
    assert lines[-1] == "study.toml: and 480 more errors; correct those above first"
    assert max(map(len, lines)) < 250


@pytest.mark.parametrize(
    "text",
    [
        "version = " + "9" * 5000,
        "version = 0x" + "f" * 5000,
        "version = " + "[" * 5000 + "]" * 5000,
        "version = [" * 3000,
        "a." * 3000 + "b = 1",
        "version = 1e999",
        "version = nan",
        "version = 1\n\0 = 2",
        "version = '\ud800'",
        'engine = { name = ["replay"] }',
        "engine = 3",
        "[engine]\nname = {}",
        "[method]\nname = 3\noptions = 4",
        "[links]\nfile = '" + "f" * 5000 + "'",
        '[links]\nfile = "a\\u0000b"',
        "[parameters]\n'" + "p" * 100_000 + "' = 3",
        "parameters = 3",
        "trace = { samples = 99999999999999999999 }",
        "trace = { max_depth = 1000 }",
        "trace = { seed = 99999999999999999999 }",
        "fidelity = { rounds = 1000000 }",
    ],
    ids=lambda text: ascii(text[:30]),
)
def test_bombs_and_oddities_in_a_study_file(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(InputError) as caught:
        Study.load(path)
    assert str(path) in str(caught.value)
    assert max(map(len, str(caught.value).splitlines())) < 1000


@pytest.mark.parametrize("file", ["f" * 5000, "a\\u0000b", "/dev/zero"])
def test_files_that_cannot_be_are_named(folder, file):
    with pytest.raises(InputError, match=r"study\.toml: links\.file = .*: no such file"):
        load(folder, MINIMAL.replace("links.csv", file))


@pytest.mark.parametrize("name", ["/dev/zero", "s" * 5000, "a\0b"])
def test_a_study_that_is_no_file(name):
    with pytest.raises(InputError, match="no such study file"):
        Study.load(name)
