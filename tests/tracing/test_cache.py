"""Kept traces: given back as they were kept; a damaged one is dropped with a line and never becomes a number."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import synthetic
from calibray.fields import path_loss
from calibray.study import Setup, Study
from calibray.support import cache_folder as caching
from calibray.tracing import cache
from small_scenes import block, write_scene


@pytest.fixture
def entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A kept trace with the fingerprint "d"."""
    monkeypatch.setenv(caching.CACHE_VARIABLE, str(tmp_path))
    cache.store_trace("d", synthetic.program(synthetic.EVERY_KIND))
    return tmp_path / "d.h5"


def test_what_was_kept_is_found(entry: Path, caplog: pytest.LogCaptureFixture) -> None:
    found = cache.load_trace("d")
    np.testing.assert_array_equal(found.tx_field, synthetic.program(synthetic.EVERY_KIND).tx_field)
    assert cache.load_trace("other") is None
    assert not caplog.records


@pytest.mark.parametrize("damage", ["flipped", "cut", "emptied", "foreign", "a folder"])
def test_a_damaged_entry_is_dropped_with_a_line(
    entry: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    whole = bytearray(entry.read_bytes())
    if damage == "flipped":
        # A field's bits in place of another number: nothing but the checksum tells.
        whole[whole.rindex(np.float64(synthetic.program(synthetic.EVERY_KIND).delay[0]).tobytes())] ^= 1
    contents = {"flipped": bytes(whole), "cut": bytes(whole[:-9]), "emptied": b"", "foreign": b"x,y\n1,2\n"}
    if damage == "a folder":
        entry.unlink()
        entry.mkdir()
        assert cache.load_trace("d") is None
        return
    entry.write_bytes(contents[damage])
    with caplog.at_level(logging.WARNING):
        assert cache.load_trace("d") is None
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "d.h5: is damaged" in caplog.text
    assert "traced again" in caplog.text
    assert not entry.exists()


def test_a_folder_that_cannot_be_written_is_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(caching.CACHE_VARIABLE, str(tmp_path / "file"))
    cache.store_trace("d", synthetic.program(synthetic.EVERY_KIND))
    assert cache.load_trace("d") is None
    monkeypatch.setenv(caching.CACHE_VARIABLE, "")
    cache.store_trace("d", synthetic.program(synthetic.EVERY_KIND))
    assert cache.load_trace("d") is None


def test_a_link_or_a_file_that_others_can_write_to_is_not_used(entry, caplog):
    assert cache.load_trace("d") is not None
    entry.chmod(0o666)
    with caplog.at_level(logging.WARNING):
        assert cache.load_trace("d") is None
    assert "is writable by others" in caplog.text
    entry.chmod(0o600)
    assert cache.load_trace("d") is not None
    hidden = entry.rename(entry.with_name("hidden.h5"))
    entry.symlink_to(hidden)
    assert cache.load_trace("d") is None


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give files away")
def test_a_trace_that_another_user_planted_is_not_used(entry, caplog):
    """Its seal, a plain digest, is right: anybody can compute it."""
    os.chown(entry, 65534, 65534)
    with caplog.at_level(logging.WARNING):
        assert cache.load_trace("d") is None
    assert "belongs to another user" in caplog.text
    cache.store_trace("d", synthetic.program(synthetic.EVERY_KIND))
    assert entry.stat().st_uid == 0
    assert cache.load_trace("d") is not None


def test_a_stored_trace_is_used_whatever_the_umask(entry):
    old = os.umask(0)
    try:
        cache.store_trace("e", synthetic.program(synthetic.EVERY_KIND))
    finally:
        os.umask(old)
    assert cache.load_trace("e") is not None


def test_a_mesh_that_changed_after_it_was_loaded_leaves_no_trace_for_its_new_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(caching.CACHE_VARIABLE, str(tmp_path / "cache"))

    def scene(west: float) -> Path:
        ground = [[(-60.0, -60.0, 0.0), (60.0, -60.0, 0.0), (60.0, 60.0, 0.0), (-60.0, 60.0, 0.0)]]
        wall = block((west, -30.0, 0.0), (west + 4.0, 30.0, 9.0))
        return write_scene(tmp_path, {"ground": ground, "wall": wall})

    columns = ["tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z"]
    link = pd.DataFrame([[0.0, 0.0, 5.0, 0.0, 20.0, 1.5]], columns=columns)
    link.assign(path_loss_db=80.0).to_csv(tmp_path / "links.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": str(scene(10.0)), "frequency": 3.5e9},
        "links": {"file": "links.csv", "tx": columns[:3], "rx": columns[3:], "value": "path_loss_db"},
        "trace": {"max_depth": 1, "samples": 20_000},
        "parameters": {"stone.relative_permittivity": {"bounds": [2.0, 9.0]}},
    }
    study = Study.from_content(content, tmp_path / "study.toml")
    opened = Setup.open(study)
    before = opened.tracer.trace(opened.links)
    scene(12.0)
    # What is opened stays as it was read.
    assert path_loss(opened.trace()) == pytest.approx(path_loss(before), abs=1e-9)
    again = Setup.open(study)
    expected = path_loss(again.tracer.trace(again.links))
    assert abs(expected - path_loss(before)) > 0.01
    assert path_loss(again.trace()) == pytest.approx(expected, abs=1e-9)
