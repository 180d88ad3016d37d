"""The cache folder: its path, who may write to it, and stores of checksummed entries."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from calibray.support.cache_folder import CACHE_VARIABLE, Store, cache_folder, compiled_programs


def test_the_folder_is_named_by_the_variable_or_is_the_users(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.setenv(CACHE_VARIABLE, "")
    assert cache_folder() is compiled_programs() is None
    monkeypatch.delenv(CACHE_VARIABLE)
    assert cache_folder().name == "calibray"


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have another default folder")
def test_the_users_folder_follows_xdg_cache_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(CACHE_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "calibray"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert cache_folder() == Path.home() / ".cache" / "calibray"


def test_only_a_folder_that_belongs_to_the_user_is_trusted(tmp_path: Path) -> None:
    own = Store(tmp_path / "own", ".x", 100)
    assert own.trusted
    assert own.path.stat().st_mode & 0o077 == 0
    (tmp_path / "link").symlink_to(own.path)
    assert not Store(tmp_path / "link", ".x", 100).trusted
    (tmp_path / "file").write_text("")
    assert not Store(tmp_path / "file", ".x", 100).trusted
    assert not Store(tmp_path / "file" / "below", ".x", 100).trusted
    if os.geteuid() == 0:
        os.chown(own.path, 12345, -1)
        assert not own.trusted


def test_a_folder_that_others_can_write_to_is_neither_read_nor_written(tmp_path: Path) -> None:
    """Whatever was true when the program started."""
    store = Store(tmp_path / "own", ".x", 1000)
    store.put("a", b"machine code")
    assert store.get("a") == b"machine code"
    store.path.chmod(0o777)
    assert store.get("a") is None
    store.put("b", b"other code")
    store.path.chmod(0o700)
    assert store.get("a") == b"machine code"
    assert store.get("b") is None
    # Another folder under the same path.
    store.path.rename(tmp_path / "elsewhere")
    store.path.symlink_to(tmp_path / "elsewhere")
    assert store.get("a") is None


def test_an_entry_is_not_read_or_written_through_a_link(tmp_path: Path) -> None:
    store, kept = Store(tmp_path / "own", ".x", 1000), tmp_path / "kept"
    store.put("a", b"machine code")
    (tmp_path / "own" / "a.x").rename(kept)
    (tmp_path / "own" / "a.x").symlink_to(kept)
    before = kept.read_bytes()
    assert store.get("a") is None
    store.put("a", b"other code")
    assert kept.read_bytes() == before
    assert store.get("a") == b"other code"


@pytest.mark.parametrize(
    "damage", [lambda entry: entry[:-1], lambda entry: b"", lambda entry: b"!" + entry[1:]]
)
def test_a_damaged_entry_is_removed(tmp_path: Path, damage) -> None:
    store = Store(tmp_path, ".x", 1000)
    store.put("a", b"machine code")
    assert store.get("a") == b"machine code"
    (tmp_path / "a.x").write_bytes(damage((tmp_path / "a.x").read_bytes()))
    assert store.get("a") is None
    assert not (tmp_path / "a.x").exists()
    assert store.get("absent") is None


def test_the_entries_read_least_recently_are_removed_above_the_limit(tmp_path: Path) -> None:
    """Not at once: about one written entry in 16 is followed by a look at all."""
    store, looked = Store(tmp_path, ".x", limit := 10 * (60 + 32)), 0
    for number in range(200):
        store.put(f"{number}", bytes(60))
        os.utime(tmp_path / f"{number}.x", (number, number))
        if number == 0:
            assert store.get("0") is not None  # from now on the youngest
        looked += sum(path.stat().st_size for path in store.entries()) <= limit
    kept = [int(path.stem) for path in store.entries()]
    assert kept == [0, *range(199, 200 - len(kept), -1)]
    assert 9 <= len(kept) < 60
    assert 10 <= looked < 60
