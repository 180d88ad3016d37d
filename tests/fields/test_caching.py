"""Compiled programs kept between runs: the second run compiles nothing, and what was damaged is compiled again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from calibray.support.cache_folder import Store

PROGRAM = """
import jax
from jax import monitoring
from collections import Counter
seen = Counter()
monitoring.register_event_listener(lambda event, **_: seen.update([event.rpartition("/")[2]]))
import calibray.fields
print(jax.jit(lambda x: jax.numpy.sin(x) * 3)(2.0), seen["cache_hits"], seen["cache_misses"])
"""


def run(folder: str | Path) -> list[str]:
    environment = {
        **{name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"},
        "CALIBRAY_CACHE": str(folder),
    }
    ran = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")
    return ran.stdout.split()


def test_a_second_process_compiles_nothing_and_damage_breaks_nothing(tmp_path: Path) -> None:
    value, hits, misses = run(tmp_path)
    assert (hits, int(misses) > 0) == ("0", True)
    assert run(tmp_path) == [value, misses, "0"]
    for path in (tmp_path / "compiled").iterdir():
        whole = bytearray(path.read_bytes())
        whole[len(whole) // 2] ^= 1
        path.write_bytes(whole)
    assert run(tmp_path) == [value, "0", misses]
    (tmp_path / "compiled").chmod(0o777)  # the negative control: whoever can write there could bring code
    assert run(tmp_path) == [value, "0", "0"]


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
