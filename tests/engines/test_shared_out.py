"""Traces, predictions and validations in blocks are those of all links at once. Worker processes: `test_dask.py`."""

from __future__ import annotations

import re
import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pandas as pd
import pyarrow
import pytest
from pyarrow import parquet
from typer.testing import CliRunner

import planted
import two_ray
from calibray import Paths
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.engines.cluster.chunks import cut, trace_in_chunks
from calibray.engines.cluster.workers import InProcess
from calibray.errors import InputError
from calibray.measurements import Measurements, PiecedTable
from calibray.prediction import batches
from calibray.prediction.batches import predict_batches, predict_links
from calibray.study import Setup
from calibray.support.output_files import growing_table
from calibray.validation.validate import validate
from link_tables import links_from_frame

OPTIONS = {"starts": 4}
SECTIONS = {"method": {"name": "least-squares", "options": OPTIONS}, "offset": {"bounds": [-5.0, 5.0]}}
PARTED = {**SECTIONS, "engine": {"name": "replay", "chunk_links": 7}}


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> Result:
    """A calibration whose study asks for blocks of 7 links."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", "")
        folder = tmp_path_factory.mktemp("found")
        return calibrate(Setup.open(two_ray.study(folder, noise_db=1.0, **PARTED), two_ray.TwoRay))


def opened(result: Result, links: Measurements) -> Setup:
    """A calibration's study, opened in the tracer of two rays."""
    return Setup.open(result.study, two_ray.TwoRay, links)


def new_links(count: int = 40) -> pd.DataFrame:
    """Links from four transmitters, mixed, so that blocks take them in another order than the table has them."""
    random = np.random.default_rng(11)
    tx = np.array([[0.0, 0, 10], [40, 0, 12], [0, 40, 8], [-30, 5, 15]])[random.integers(0, 4, count)]
    rx = np.column_stack([random.uniform(-150, 150, (count, 2)), random.uniform(1, 3, count)])
    rx[3, 2] = -1.0
    return pd.DataFrame(np.hstack([tx, rx]), columns=two_ray.COLUMNS)


@pytest.mark.parametrize("level", [None, 0.9])
def test_predictions_in_blocks_are_those_of_one_piece(found, level):
    setup = Setup.open(found.study, two_ray.TwoRay, links_from_frame(new_links()))
    told: list[tuple[str, int, int | None]] = []
    whole = predict_links(found, setup, level, with_remarks=True)
    parts = predict_links(
        found, setup, level, lambda *each: told.append(each), InProcess(at_most=1), with_remarks=True
    )
    assert any(np.diff(np.concatenate(cut(setup.links, 7))) < 0)
    assert list(parts) == list(whole)
    numbers = [name for name in whole if name.endswith("_db")]
    assert parts[numbers].to_numpy() == pytest.approx(whole[numbers].to_numpy(), rel=1e-9, nan_ok=True)
    words = [name for name in whole if name not in numbers]
    assert (parts[words] == whole[words]).all(axis=None)
    assert parts.remark[3] == "receiver under the ground"
    assert told[-1] == ("tracing", 40, 40)
    assert len(told) == 6


def test_a_trace_in_blocks_is_that_of_one_piece(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    setup = Setup.open(two_ray.study(tmp_path, **PARTED), two_ray.TwoRay, links_from_frame(new_links()))
    parts, unchecked = trace_in_chunks(setup, InProcess())
    assert (tmp_path / two_ray.TRACED).read_text().split() == ["7", "7", "7", "7", "6", "6"]
    whole = setup.tracer.trace(setup.links)
    for each in fields(Paths):
        if isinstance(getattr(whole, each.name), np.ndarray):
            assert np.array_equal(getattr(parts, each.name), getattr(whole, each.name)), each.name
    assert (parts.materials, unchecked) == (whole.materials, None)


def test_rounds_of_the_worst_block_are_told(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    setup = Setup.open(two_ray.study(tmp_path, **PARTED), two_ray.TwoRay)
    plain = Setup.trace

    def rounds(self, *given):
        height = float(self.links.distance.max())
        return replace(plain(self, *given), settings={"rays": int(height), "last_round_db": 1 / height})

    monkeypatch.setattr(Setup, "trace", rounds)
    distance = setup.links.distance
    paths, _ = trace_in_chunks(setup, InProcess())
    nearest = max(distance[block].max() for block in cut(setup.links, 7))
    assert paths.settings["rays"] == int(nearest)
    assert paths.settings["last_round_db"] == max(1 / distance[block].max() for block in cut(setup.links, 7))


def test_a_validation_in_blocks_is_that_of_one_piece(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    study = two_ray.study(tmp_path, noise_db=1.0, **SECTIONS)
    whole = validate(Setup.open(study, two_ray.TwoRay), blocks=2)
    (tmp_path / two_ray.TRACED).unlink()
    parted = two_ray.study(tmp_path, noise_db=1.0, **PARTED)
    found = validate(Setup.open(parted, two_ray.TwoRay), blocks=2, workers=InProcess())
    assert len((tmp_path / two_ray.TRACED).read_text().split()) == 5
    assert set(found.errors) == set(whole.errors)
    for name, errors in whole.errors.items():
        assert found.errors[name] == pytest.approx(errors, rel=1e-9, abs=1e-9, nan_ok=True), name


def test_the_command_stores_a_trace_in_blocks_and_checks_it(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    (tmp_path / "parted.toml").write_text(
        f"""
version = 1
scene = {{ file = "sionna:simple_street_canyon", frequency = 3.5e9 }}
links = {{ file = "links.csv", tx = {list(planted.COLUMNS[:3])}, rx = {list(planted.COLUMNS[3:])}, value = "loss" }}
trace = {{ max_depth = 1, samples = 5_000, line_of_sight = true }}
engine = {{ name = "replay", chunk_links = 6 }}
parameters = {{ "concrete.relative_permittivity" = {{ bounds = [1.5, 12.0] }} }}
"""
    )
    planted.links().assign(loss=90.0).to_csv(tmp_path / "links.csv", index=False)
    out = tmp_path / "paths.h5"
    outcome = CliRunner().invoke(app, ["trace", str(tmp_path / "parted.toml"), "-o", str(out), "--check"])
    assert outcome.exit_code == 0, outcome.output
    paths = Paths.load(out)
    assert paths.num_links == planted.LINKS
    assert paths.rx_position[:, 0] == pytest.approx(planted.links().rx_x.to_numpy())
    assert "Change from 5,000 to 10,000 samples" in outcome.stdout
    assert re.search(rf"^links +{planted.LINKS}$", outcome.stdout, re.MULTILINE)


def mixed(count: int) -> pd.DataFrame:
    """Links with columns that are passed on: words, whole numbers of which one is missing, and truth values."""
    hole = pd.array(range(count), dtype="Int64")
    hole[count // 2] = pd.NA
    words = np.where(np.arange(count) < count // 2, None, "far")
    return new_links(count).assign(
        number=np.arange(count), hole=hole, words=words, odd=np.arange(count) % 2 == 1
    )


@pytest.mark.parametrize("kind", [".csv", ".parquet"])
@pytest.mark.parametrize("given", [".csv", ".parquet"])
def test_what_is_written_in_pieces_is_what_is_written_at_once(found, tmp_path, monkeypatch, given, kind):
    source = tmp_path / f"links{given}"
    if given == ".csv":
        mixed(40).to_csv(source, index=False)
    else:
        # Without what pandas adds whole numbers of which one is missing are floats.
        plain = pyarrow.Table.from_pandas(mixed(40), preserve_index=False).replace_schema_metadata(None)
        parquet.write_table(plain, source)
    found.save(tmp_path / "out")
    monkeypatch.setattr(
        batches, "open_for_links", lambda result, links, allow_changed_inputs: opened(result, links)
    )
    written = []
    for size in (40, 9):
        monkeypatch.setattr(batches, "BATCH", size)
        out = tmp_path / f"told{size}{kind}"
        words = ["predict", str(tmp_path / "out"), str(source), "-o", str(out), "--level", "0.9"]
        outcome = CliRunner().invoke(app, words)
        assert outcome.exit_code == 0, outcome.output
        assert "receiver under the ground: 1 of 40 links, row" in outcome.stderr
        written.append((pd.read_csv if kind == ".csv" else pd.read_parquet)(out))
    pd.testing.assert_frame_equal(written[1], written[0], rtol=1e-9)
    assert len(written[0]) == 40
    assert sorted(each.name for each in tmp_path.glob("told*")) == [f"told40{kind}", f"told9{kind}"]


def test_a_row_that_cannot_be_used_is_refused_before_any_is_traced(found, tmp_path, monkeypatch):
    table = new_links()
    table.loc[37, "rx_x"] = np.nan
    table.to_parquet(tmp_path / "links.parquet")
    monkeypatch.setattr(
        batches, "open_for_links", lambda result, links, allow_changed_inputs: opened(result, links)
    )
    monkeypatch.setattr(batches, "BATCH", 9)
    monkeypatch.setattr(Setup, "trace", None)
    rows = predict_batches(found, PiecedTable.open(tmp_path / "links.parquet"), None)
    with pytest.raises(InputError, match="'rx_x' has missing or non-finite values in 1 of 4 rows"):
        next(rows)


def test_only_a_table_without_a_receiver_near_the_scene_is_refused(found, tmp_path, monkeypatch):
    """Not a table of which one batch is far, as of a drive through several towns."""
    monkeypatch.setattr(
        batches, "open_for_links", lambda result, links, allow_changed_inputs: opened(result, links)
    )
    monkeypatch.setattr(batches, "BATCH", 9)
    table = new_links()
    for first, file in ((20, "partly.csv"), (0, "all.csv")):
        table.loc[first:, "rx_x"] += 1e6
        table.to_csv(tmp_path / file, index=False)
    predicted = predict_batches(found, PiecedTable.open(tmp_path / "partly.csv"), None)
    assert sum(len(rows) for _, rows in predicted) == 40
    with pytest.raises(InputError, match="all receivers are more than"):
        next(predict_batches(found, PiecedTable.open(tmp_path / "all.csv"), None))


@pytest.mark.parametrize("kind", [".csv", ".parquet"])
def test_a_failure_in_the_midst_leaves_no_table(tmp_path, kind):
    def full() -> None:
        with growing_table(tmp_path / f"told{kind}") as append:
            append(new_links())
            assert list(tmp_path.iterdir())
            raise OSError(28, "the disk is full")

    with pytest.raises(OSError, match="full"):
        full()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", [".csv", ".parquet"])
def test_memory_does_not_grow_with_the_rows(found, tmp_path, monkeypatch, kind):
    def cheap(result, setup, *_, **__):
        return pd.DataFrame({"path_loss_db": setup.links.distance, "remark": ""})

    monkeypatch.setattr(
        batches, "open_for_links", lambda result, links, allow_changed_inputs: opened(result, links)
    )
    monkeypatch.setattr(batches, "predict_links", cheap)
    monkeypatch.setattr(batches, "BATCH", 250)
    peaks = []
    for count in (250, 1_000, 12_000):
        source = tmp_path / f"links{count}.parquet"
        new_links(count).to_parquet(source, row_group_size=500)
        before = pyarrow.total_allocated_bytes()
        tracemalloc.start()
        arrow = 0
        with growing_table(tmp_path / f"told{count}{kind}") as append:
            for links, told in predict_batches(found, PiecedTable.open(source), None):
                append(links.frame.assign(path_loss_db=told["path_loss_db"]))
                arrow = max(arrow, pyarrow.total_allocated_bytes() - before)
        peaks.append(tracemalloc.get_traced_memory()[1] + arrow)
        tracemalloc.stop()
    assert peaks[2] < 1.3 * peaks[1]
    assert peaks[2] < 12_000 * 7 * 8
    told = (pd.read_csv if kind == ".csv" else pd.read_parquet)(tmp_path / f"told12000{kind}")
    rows = told[list(two_ray.COLUMNS)].to_numpy()
    assert told.path_loss_db.to_numpy() == pytest.approx(np.linalg.norm(rows[:, 3:] - rows[:, :3], axis=1))
    assert len(told) == 12_000
