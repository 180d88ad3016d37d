"""Compiled programs kept between runs: the second run compiles nothing, and what was damaged is compiled again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
