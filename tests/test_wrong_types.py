"""Arguments of public functions that have the wrong type: messages name the argument, the value and a remedy."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest

import calibray as cb
from calibray.errors import InputError
from calibray.scenarios import demo_study_path
from shown import GOLDEN

LINKS = pd.DataFrame({
    "tx_x": [0.0], "tx_y": 0.0, "tx_z": 12.0, "rx_x": 20.0, "rx_y": 5.0, "rx_z": 1.5, "half": "west"
})  # fmt: skip
NAMES = dict.fromkeys((None, 5, b"out", ("out",)), r"must be the name of a file or folder, as text or Path")


@pytest.fixture(scope="module")
def study() -> cb.Study:
    return cb.Study.load(demo_study_path())


@pytest.fixture(scope="module")
def paths() -> cb.Paths:
    return cb.Paths.load(GOLDEN / "paths.h5")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> cb.Result:
    """The golden result with its inputs."""
    folder = tmp_path_factory.mktemp("wrong") / "study"
    shutil.copytree(GOLDEN / "study", folder)
    shutil.copytree(GOLDEN / "result", folder / "out")
    stored = json.loads((folder / "out" / "result.json").read_text())
    (folder / "out" / "result.json").write_text(
        json.dumps(stored | {"study_file": str(folder / "study.toml")})
    )
    return cb.Result.load(folder / "out", allow_changed_inputs=True)


def refused(message: str, call: Callable[[], object]) -> None:
    with pytest.raises(InputError, match=message):
        call()


@pytest.mark.parametrize("name", NAMES)
def test_a_file_or_folder_has_a_name(study: cb.Study, paths: cb.Paths, result: cb.Result, name: Any) -> None:
    calls: dict[str, Callable[[Any], object]] = {
        "study": cb.Study.load, "result": cb.Result.load, "path file": cb.Paths.load, "output folder": result.save,
        "output file": result.report, "output file ": paths.save, "output folder ": result.export,
        "table": lambda file: cb.read_measurements(file, (0, 0, 0), (1, 1, 1), "loss"),
    }  # fmt: skip
    for role, call in calls.items():
        refused(f"^{role.strip()}: is a {type(name).__name__}, {NAMES[name]}", lambda call=call: call(name))
    if name is not None:
        refused("^output folder: is a", lambda: cb.calibrate(study, out=name))


@pytest.mark.parametrize("level", ["0.9", [0.9], 0.9j, 90, True])
def test_a_level_is_a_probability(result: cb.Result, level: Any) -> None:
    message, place = "level = .*: must be between 0 and 1, such as 0.9", {"half": "west"}
    refused(message, lambda: result.predict_interval(LINKS, level))
    refused(message, lambda: result.coverage_map([0, 0, 12], cell=50, columns=place, level=level))


@pytest.mark.parametrize("count", ["3", None, [1], 2.5, np.nan, True, 0])
def test_a_count_is_a_whole_number(result: cb.Result, count: Any) -> None:
    refused("count = .*: must be a whole number of at least 1", lambda: result.suggest(LINKS, count))


@pytest.mark.parametrize("columns", ["cell", [1], 5])
def test_columns_of_a_map_are_a_dictionary(result: cb.Result, columns: Any) -> None:
    refused(
        "columns = .*: must be a dictionary", lambda: result.coverage_map([0, 0, 9], cell=50, columns=columns)
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"engine": "replay"}, r"engine: is 'replay', .* study\.replace\(engine=NAME\)"),
        ({"workers": 4}, r"workers: is 4, must be workers from engines\.open_workers"),
        ({"cheap_model": "study.toml"}, "cheap_model: is 'study.toml', must be a Study"),
    ],
)
def test_arguments_of_a_calibration(study: cb.Study, arguments: dict, message: str) -> None:
    refused(message, lambda: cb.calibrate(study, **arguments))


def test_what_is_no_study_no_links_and_no_material(study: cb.Study, paths: cb.Paths) -> None:
    table = pd.DataFrame({"rx_x": [1.0]})
    for value in (None, "study.toml"):
        refused("study: is a .*, must be a Study; read a file", lambda value=value: cb.validate(value))
    for blocks in (2.5, "3", True):
        refused(
            "blocks = .*; must be a whole number from 2 to 100", lambda b=blocks: cb.validate(study, blocks=b)
        )
    refused("study.toml: is a list, must be a dictionary", lambda: cb.Study.from_content([1]))
    refused(
        r"links: is a pandas\.DataFrame, must have positions",
        lambda: cb.trace("sionna:munich", table, frequency=3e9),
    )
    refused(r"not a pandas\.DataFrame; use read_measurements", lambda: cb.trace(study, table))
    refused("frequency = '3e9': must be a finite number", lambda: cb.itu_material("concrete", "3e9"))
    refused("frequency = '3e9': must be in 1e", lambda: paths.at("3e9"))
    name = next(iter(paths.materials))
    refused(f"material '{name}': is 5, must be a Material", lambda: cb.path_loss(paths, {name: 5}))


def test_links_of_arrays(result: cb.Result) -> None:
    ends = {"tx": [[0, 0, 9]] * 2, "rx": [[1, 2, 3], [4, 5, 6]]}
    masked = np.ma.masked_array([80.0, 1e20], mask=[False, True])
    refused("only some links have a path loss", lambda: cb.Measurements(**ends, path_loss_db=masked))
    refused("rx position|receiver's position is not finite", lambda: cb.Measurements(
        tx=ends["tx"], rx=np.ma.masked_equal(ends["rx"], 6), path_loss_db=[80.0, 90.0]
    ))  # fmt: skip
    refused("path_loss_db: cannot be used", lambda: cb.Measurements(**ends, path_loss_db=["80", "far"]))
    refused("path_loss_db: cannot be used", lambda: cb.Measurements(**ends, path_loss_db=[80j, 90]))
    refused("column 'rx_x' contains complex numbers", lambda: result.predict(LINKS.assign(rx_x=1j)))
    refused("links: is a dict, .* table.to_pandas", lambda: result.predict(LINKS.to_dict()))
