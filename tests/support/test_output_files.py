"""Outputs replace only files that Calibray wrote and nobody changed."""

from __future__ import annotations

import os
import subprocess
import time
from types import SimpleNamespace

import h5py
import numpy as np
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.paths import seal
from calibray.support.output_files import (
    SIGNATURES,
    check_file,
    check_outputs,
    check_table,
    check_unchanged,
    csv_text,
    is_unchanged_output,
    replacing,
    without_formula_mark,
    write_table,
    write_text,
)

TABLE = pd.DataFrame({"a": [1.0, 2.0]})


def test_an_output_may_be_replaced_unless_it_was_changed(tmp_path):
    for name, write in {
        "a.txt": lambda file: write_text(file, "one"),
        "a.csv": lambda file: write_table(file, TABLE),
    }.items():
        file = tmp_path / name
        for _ in range(2):
            assert check_file(file) == file
            write(file)
            assert is_unchanged_output(file)
        file.write_text(file.read_text() + "by hand")
        assert not is_unchanged_output(file)
        with pytest.raises(
            InputError, match=r"was not written by Calibray, or has changed since.*--overwrite"
        ):
            check_file(file)
        assert check_file(file, overwrite=True) == file
        write(file)
        assert check_file(file) == file


def test_path_files_are_recognised_without_a_signature(tmp_path):
    file = tmp_path / "paths.h5"
    with h5py.File(file, "w") as content:
        content.attrs["format"] = "calibray/paths"
    assert not is_unchanged_output(file)
    seal(file)
    (tmp_path / SIGNATURES).unlink()
    assert is_unchanged_output(file)


def test_a_copy_under_another_name_is_not_an_output(tmp_path):
    write_text(tmp_path / "a.txt", "one")
    (tmp_path / "b.txt").write_text("one")
    assert not is_unchanged_output(tmp_path / "b.txt")
    (tmp_path / "c.txt").touch()
    assert check_file(tmp_path / "c.txt")  # an empty file may be replaced


@pytest.mark.parametrize("overwrite", [False, True])
def test_inputs_links_and_devices_are_never_replaced(tmp_path, overwrite):
    source = tmp_path / "links.csv"
    write_table(source, TABLE)
    (tmp_path / "hard.csv").hardlink_to(source)
    (tmp_path / "soft.csv").symlink_to(source)
    (tmp_path / "dangling.csv").symlink_to(tmp_path / "nowhere")
    os.mkfifo(tmp_path / "fifo.csv")
    (tmp_path / "null.csv").symlink_to("/dev/null")
    for name, message in {
        "links.csv": "is an input; name another file",
        "hard.csv": "is an input; name another file",
        "soft.csv": "is a symbolic link",
        "dangling.csv": "is a symbolic link",
        "null.csv": "is a symbolic link",
        "fifo.csv": "is a folder, a device or a FIFO",
    }.items():
        with pytest.raises(InputError, match=message):
            check_table(tmp_path / name, [source, tmp_path / "absent"], overwrite)
        with pytest.raises(InputError, match=message):
            check_outputs(tmp_path, ["other", name], [source], overwrite)
    with pytest.raises(InputError, match="is a folder, a device or a FIFO"):
        check_file("/dev/null", overwrite=overwrite)
    assert check_outputs(tmp_path, ["other.json"], [source], overwrite) == tmp_path


def test_the_old_file_is_recognised_after_a_kill_between_signing_and_moving(tmp_path):
    file = tmp_path / "a.txt"
    write_text(file, "one")

    def interrupted() -> None:
        with replacing(file) as partial:
            partial.write_text("two")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert is_unchanged_output(file)
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".part"] == []
    for torn in ("", "ab", "\ufffd"):
        with (tmp_path / SIGNATURES).open("a") as signatures:
            signatures.write(f"{torn}\n")
    assert is_unchanged_output(file)


def test_unfinished_files_of_ended_processes_are_removed(tmp_path):
    ended = subprocess.Popen(["true"])
    ended.wait()
    names = {
        "old": f"a.txt.{ended.pid}-0123456789abcdef0123456789abcdef.part",
        "alive": f"a.txt.{os.getpid()}-0123456789abcdef0123456789abcdef.part",
        "users": "a.txt.my-own.part",
    }
    for name in names.values():
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time.time() - 1000,) * 2)
    (tmp_path / f"a.txt.{ended.pid}-new.part").touch()
    write_text(tmp_path / "a.txt", "one")
    remaining = {path.name for path in tmp_path.iterdir()} - {"a.txt", SIGNATURES}
    assert remaining == {names["alive"], names["users"], f"a.txt.{ended.pid}-new.part"}


def _plant(kind: str, file, precious) -> None:
    """Put something under a file's name that Calibray did not write."""
    if kind == "link":
        file.symlink_to(precious)
    elif kind == "dangling link":
        file.symlink_to(precious.with_name("nowhere"))
    elif kind == "device":
        file.symlink_to("/dev/zero")
    elif kind == "FIFO":
        os.mkfifo(file)
    elif kind == "folder":
        file.mkdir()
    elif kind == "file of another program":
        file.write_text("[calibray]\nverbose = true\n")
    else:
        with file.open("wb") as stream:
            stream.truncate(3 * 2**30)


PLANTS = ("link", "dangling link", "device", "FIFO", "folder", "file of another program", "3 GB")


@pytest.mark.parametrize("kind", PLANTS)
def test_only_its_own_signature_file_is_read_and_appended_to(tmp_path, kind):
    precious, folder = tmp_path / "precious.txt", tmp_path / "out"
    precious.write_text("years of work")
    folder.mkdir()
    _plant(kind, folder / SIGNATURES, precious)
    with pytest.raises(
        InputError, match=r"\.calibray: Calibray keeps.*; move it away, or name another folder"
    ):
        check_outputs(folder, ["a.txt"])
    with pytest.raises(InputError, match=r"move it away"):
        check_file(folder / "a.txt")
    with pytest.raises(InputError, match=r"move it away"):
        write_text(folder / "a.txt", "one")
    (folder / "users.txt").write_text("by hand")
    assert not is_unchanged_output(folder / "users.txt")
    check_unchanged(folder / "users.txt")
    assert {entry.name for entry in folder.iterdir()} == {SIGNATURES, "users.txt"}
    assert [entry.name for entry in tmp_path.iterdir() if entry.is_file()] == ["precious.txt"]
    assert precious.read_text() == "years of work"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give files away")
def test_the_signature_file_of_another_user_is_not_used(tmp_path):
    file = tmp_path / "a.txt"
    write_text(file, "one")
    assert is_unchanged_output(file)
    os.chown(tmp_path / SIGNATURES, 65534, 65534)
    assert not is_unchanged_output(file)
    with pytest.raises(InputError, match="belongs to another user"):
        check_file(file)


def test_an_unfinished_file_is_created_and_never_followed(tmp_path, monkeypatch):
    """Not even if somebody knows its name, or exchanges it while it is written."""
    precious, file = tmp_path / "precious.txt", tmp_path / "a.txt"
    precious.write_text("years of work")

    def exchange() -> None:
        with replacing(file) as partial:
            partial.unlink()
            partial.symlink_to(precious)

    with pytest.raises(InputError, match="another program replaced"):
        exchange()
    name = "0" * 32
    monkeypatch.setattr("uuid.uuid4", lambda: SimpleNamespace(hex=name))
    planted = tmp_path / f"a.txt.{os.getpid()}-{name}.part"
    planted.symlink_to(precious)
    with pytest.raises(FileExistsError):
        write_text(file, "one")
    assert precious.read_text() == "years of work"
    assert planted.is_symlink()
    assert not file.exists()


@pytest.mark.parametrize("kind", ["link", "dangling link", "device", "FIFO", "folder"])
def test_nothing_but_a_file_is_replaced_even_unchecked(tmp_path, kind):
    precious, file = tmp_path / "precious.txt", tmp_path / "a.txt"
    precious.write_text("years of work")
    _plant(kind, file, precious)
    with pytest.raises(InputError, match=r"output file .*: is a"):
        write_text(file, "one")
    assert precious.read_text() == "years of work"


def test_texts_that_a_spreadsheet_would_compute_are_marked(tmp_path):
    attack = '=HYPERLINK("http://localhost")'
    texts = [
        attack,
        "+1+1",
        "-1+1",
        "@SUM(1)",
        "\t=1",
        "\r=1",
        "\uff1d1",
        "'=1",
        "east",
        "-80.5",
        "-",
        "1e5",
        "",
    ]
    table = pd.DataFrame({attack: texts, "value": [-float(k) for k in range(len(texts))]})
    write_table(tmp_path / "a.csv", table)
    read = pd.read_csv(tmp_path / "a.csv", dtype=str, keep_default_na=False)
    assert list(read) == [f"'{attack}", "value"]
    assert read["value"].tolist() == [str(-float(k)) for k in range(len(texts))]
    marked = read[f"'{attack}"].tolist()
    assert marked == [f"'{text}" for text in texts[:8]] + texts[8:]
    assert [without_formula_mark(text) for text in marked] == texts
    assert table.columns[0] == attack  # the caller's table stays


def test_a_table_without_texts_is_written_by_pandas_alone():
    table = pd.DataFrame({"a": [1.5, np.nan], "b": [True, False], "c": [None, 2.25], "a b": ["x", None]})
    assert csv_text(table, "%.1f") == table.to_csv(index=False, float_format="%.1f")
    twice = pd.concat([table, table], axis=1)
    assert csv_text(twice) == twice.to_csv(index=False)
