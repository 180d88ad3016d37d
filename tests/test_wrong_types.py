"""Arguments of public functions that have the wrong type: messages name the argument, the value and a remedy."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import calibray as cb
from calibray import engines
from calibray.errors import EngineError, InputError
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
        refused(
            f"^{role.strip()}: is a {type(name).__name__}; it {NAMES[name]}", lambda call=call: call(name)
        )
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
        ({"engine": "replay"}, r"engine: is 'replay'; .* study\.replace\(engine=NAME\)"),
        ({"workers": 4}, r"workers: is 4; it must be workers from engines\.open_workers"),
        ({"cheap_model": "study.toml"}, "cheap_model: is 'study.toml'; it must be a Study"),
    ],
)
def test_arguments_of_a_calibration(study: cb.Study, arguments: dict, message: str) -> None:
    refused(message, lambda: cb.calibrate(study, **arguments))


def test_workers_are_opened(study: cb.Study, result: cb.Result) -> None:
    place = {"half": "west"}
    calls: tuple[Callable[[], object], ...] = (
        lambda: cb.validate(study, blocks=3, workers=2),
        lambda: engines.make(study, workers=2),
        lambda: result.coverage_map([0, 0, 12], cell=50, columns=place, workers=2),
    )
    for call in calls:
        refused(r"workers: is 2; it must be workers from engines\.open_workers", call)
    for number in ("2", 1.5, True):
        with pytest.raises(InputError, match=r"workers: is .*; it must be a whole number"):
            engines.open_workers(number).__enter__()
    with pytest.raises(InputError, match=r"scheduler: is 5; it must be an address"):
        engines.open_workers(scheduler=5).__enter__()


@pytest.mark.parametrize("samples", [0, -1, True, 2.5, "many"])
def test_a_number_of_rays(result: cb.Result, samples: Any) -> None:
    refused(
        "samples: is .*, must be a number of rays",
        lambda: result.coverage_map([0, 0, 12], cell=50, columns={"half": "west"}, samples=samples),
    )


def test_numbers_of_numpy_are_numbers(study: cb.Study) -> None:
    content = study.content()
    content["trace"]["max_depth"] = np.int64(3)
    name = next(iter(content["parameters"]))
    content["parameters"][name]["bounds"] = np.array([1.5, 9.0])
    content["method"]["seed"] = np.uint8(7)
    converted = cb.Study.from_content(content)
    assert (converted.trace.max_depth, converted.method.seed) == (3, 7)
    assert converted.parameters[name].bounds == (1.5, 9.0)
    assert study.replace(seed=np.int64(7)).method.seed == 7


class Answers:
    """An engine that returns what a function makes of the true path loss."""

    def __init__(self, study: cb.Study, change: Callable[[np.ndarray], Any]) -> None:
        self._engine, self._change = engines.make(study), change
        self.parameters, self.materials, self.calls = self._engine.parameters, self._engine.materials, 0

    def path_loss(self, candidates: np.ndarray) -> Any:
        self.calls += len(candidates)
        return self._change(self._engine.path_loss(candidates))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda loss: None, "Answers returned a NoneType from path_loss; it must be a NumPy array"),
        (lambda loss: loss.tolist(), "returned a list from path_loss"),
        (lambda loss: np.vstack([loss, loss]), r"shape \(2, .*with 1 rows"),
        (lambda loss: loss[:, 1:], "returned path loss for .* links, but must return it for"),
        (lambda loss: np.where(np.arange(loss.shape[1]) == 3, np.nan, loss), "NaN or -inf .* of link 3"),
        (lambda loss: loss + 0j, "type complex128"),
    ],
)
def test_what_an_engine_returns(study: cb.Study, change: Callable[[np.ndarray], Any], message: str) -> None:
    with pytest.raises(EngineError, match=message):
        cb.calibrate(study.replace(method="gwo"), engine=Answers(study, change))


def test_what_is_no_result(study: cb.Study, tmp_path: Path) -> None:
    for call in (
        lambda: cb.coverage_map(study, [0, 0, 10]),
        lambda: cb.suggest(study, LINKS),
        lambda: cb.report(study, tmp_path / "a.html"),
    ):
        refused(r"result: is a .*Study, must be a Result; read one with Result\.load", call)
    refused("study: is an? int; it must be a Study", lambda: engines.make(5))


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
        r"links: is a pandas\.DataFrame, but must have positions",
        lambda: cb.trace("sionna:munich", table, frequency=3e9),
    )
    refused(r"not a pandas\.DataFrame; use read_measurements", lambda: cb.trace(study, table))
    for frequency in ("3e9", 3.5):
        refused(
            f"frequency = {frequency!r}: must be from .* write 28.5 GHz as 28.5e9",
            lambda frequency=frequency: cb.itu_material("concrete", frequency),
        )
    refused("conductivity: follows from ITU-R", lambda: cb.itu_material("concrete", 3e9, conductivity=1.0))
    refused("frequency = '3e9': must be from 1e", lambda: paths.at("3e9"))
    name = next(iter(paths.materials))
    refused(f"material '{name}': is 5; it must be a Material", lambda: cb.path_loss(paths, {name: 5}))


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
