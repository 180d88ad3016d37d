"""The store of compiled programs: only trusted folders and undamaged entries are used, and its size is limited."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from calibray.support.cache_folder import Store


def test_only_a_folder_of_ones_own_is_trusted(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("damage", [lambda kept: kept[:-1], lambda kept: b"", lambda kept: b"!" + kept[1:]])
def test_a_damaged_entry_is_none(tmp_path: Path, damage) -> None:
    store = Store(tmp_path, ".x", 1000)
    store.put("a", b"machine code")
    assert store.get("a") == b"machine code"
    (tmp_path / "a.x").write_bytes(damage((tmp_path / "a.x").read_bytes()))
    assert store.get("a") is None
    assert not (tmp_path / "a.x").exists()
    assert store.get("never kept") is None


def test_room_is_made_by_what_was_not_asked_for_the_longest(tmp_path: Path) -> None:
    store = Store(tmp_path, ".x", 300)
    for age, name in enumerate("abc"):
        store.put(name, bytes(60))
        os.utime(tmp_path / f"{name}.x", (age, age))
    assert store.get("a") is not None  # it is the youngest now
    store.put("d", bytes(60))
    assert {path.stem for path in store.kept()} == {"a", "c", "d"}
