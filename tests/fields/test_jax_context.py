"""Calibray computes under its own JAX settings and leaves the user's unchanged."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax._src import compilation_cache

from calibray.fields import jax_settings


@pytest.fixture(scope="module", autouse=True)
def _jax_settings() -> None:
    """Unlike other tests of this room, these begin under the user's settings."""


@pytest.fixture(scope="module", autouse=True)
def _compiled_fast() -> None:
    """They compile under the user's settings too."""


GLOBAL_STATE = """
import locale, logging, os, random, signal, sys, warnings
from collections import Counter
from importlib import import_module
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

# These packages change global settings themselves when they are imported.
import rich.console, scipy.sparse, scipy.special, threadpoolctl


def state():
    root = logging.getLogger()
    return {
        **{f"JAX's {name}": repr(value) for name, value in jax.config.values.items()},
        "JAX's cache on disk": repr(jax._src.compilation_cache._cache),
        "types of JAX": [str(jnp.asarray(1.0).dtype), str(jax.jit(lambda x: 2 * x)(1.0).dtype)],
        "names in the environment": set(os.environ),
        "values in the environment": sorted(os.environ.items()),
        "warnings": list(map(str, warnings.filters)),
        "floating-point errors": np.geterr(),
        "printing": np.get_printoptions(),
        "random numbers": [repr(random.getstate()), repr(np.random.get_state())],
        "logging": [root.level, list(map(str, root.handlers))],
        "signals": [str(signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)],
        "process": [os.getcwd(), list(sys.path), sys.getrecursionlimit(), str(sys.excepthook)],
        "locale": locale.setlocale(locale.LC_ALL),
    }


def check(step, before):
    after = state()
    for name, value in before.items():
        assert after[name] == value, f"{step} changed {name} from {value} to {after[name]}"


before = state()
import calibray
# Not the room of Sionna RT: Dr.Jit takes the path of libLLVM from the environment when it is imported.
# Not the window either: NiceGUI changes filters of warnings, in a process of its own.
left_out = {"templates", "__main__", "sionna", "window"}
source = Path(calibray.__file__).parent
modules = [file.relative_to(source.parent).with_suffix("").parts for file in source.rglob("*.py")]
modules = [".".join(parts).removesuffix(".__init__") for parts in modules if not left_out & set(parts)]
for name in modules:
    import_module(name)
check("importing all modules", before)

import synthetic
from calibray.engines import Replay
from calibray.parameters import Parameter, Parameters

paths = synthetic.program([(synthetic.Kind.SPECULAR,), ()], materials={"walls": calibray.Material(4.3, 0.08, 0.18)})
engine = Replay(paths, Parameters((Parameter("walls.thickness", 0.1, 0.5, start=0.2),)))
calls = {
    "path_loss": lambda: calibray.path_loss(paths, combining="band", bandwidth=1e6),
    "path_gains": lambda: calibray.path_gains(paths).real,
    "channel_statistics": lambda: calibray.channel_statistics(paths).delay_spread,
    "power_delay_profile": lambda: calibray.power_delay_profile(paths, np.array([0.0, 1.0])),
    "Replay.path_loss": lambda: engine.path_loss(np.array([[0.2]])),
    "Replay.path_loss_and_jacobian": lambda: engine.path_loss_and_jacobian(np.array([[0.2]]))[1],
}
seen = Counter()
jax.monitoring.register_event_listener(lambda event, **_: seen.update([event.rpartition("/")[2]]))
for name, call in calls.items():
    result = call()
    assert (type(result), result.dtype) == (np.ndarray, np.float64), name
    check(name, before)
print(len(modules), seen["cache_hits"] + seen["cache_misses"])
"""


def run(program: str, **environment: str) -> str:
    """Output of a program in a process of its own, which must not write to stderr."""
    inherited = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=inherited | environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stderr == ""
    assert done.returncode == 0
    return done.stdout


def test_importing_and_calling_calibray_changes_nothing_global() -> None:
    search = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    modules, kept = map(int, run(GLOBAL_STATE, PYTHONPATH=search, JAX_DISABLE_MOST_OPTIMIZATIONS="1").split())
    assert modules > 100
    assert kept > 0  # the calls did use the store


FORKED = """
import os, sys, warnings

import jax
from calibray.fields import jax_settings

warnings.filterwarnings("ignore", message="os.fork")  # nothing was computed yet
for step in steps:
    child = os.fork()
    if not child:
        compute(**step)
        sys.stdout.flush()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
"""

COMPILED = """
def compute(damage=False, mode=0o700, named=None):
    import json
    from collections import Counter
    from pathlib import Path

    from jax import monitoring

    if named:
        jax.config.update("jax_compilation_cache_dir", named)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    folder = Path(os.environ["CALIBRAY_CACHE"], "compiled")
    if damage:
        for path in folder.iterdir():
            content = bytearray(path.read_bytes())
            content[len(content) // 2] ^= 1
            path.write_bytes(content)
    if folder.exists():
        folder.chmod(mode)
    seen = Counter()
    monitoring.register_event_listener(lambda event, **_: seen.update([event.rpartition("/")[2]]))
    with jax_settings():
        value = float(jax.jit(lambda x: jax.numpy.sin(x) * 3)(2.0))
    inside = seen["cache_hits"], seen["cache_misses"]
    jax.jit(lambda x: jax.numpy.cos(x) * 5)(2.0)
    assert named or inside == (seen["cache_hits"], seen["cache_misses"]), "a program of the user was kept"
    print(json.dumps([value, *inside]))
"""


def outcomes(*steps: dict[str, object], **environment: str) -> list[list[float]]:
    """Value, hits and misses of processes that compile the same program one after the other.

    They are forked from one process, which imports JAX and computes nothing.
    """
    printed = run(f"steps = {steps!r}\n{COMPILED}{FORKED}", **environment)
    return [json.loads(line) for line in printed.splitlines()]


def test_a_second_process_compiles_nothing_and_damage_breaks_nothing(tmp_path: Path) -> None:
    user = tmp_path / "user"
    # negative control: others could put code into a folder that they can write
    steps = {}, {}, {"damage": True}, {"mode": 0o777}, {"named": str(user)}
    (first, second, damaged, refused, named) = outcomes(*steps, CALIBRAY_CACHE=str(tmp_path / "calibray"))
    value, hits, misses = first
    assert (hits, misses > 0) == (0, True)
    assert second == [value, misses, 0]
    assert damaged == [value, 0, misses]
    assert refused == [value, 0, 0]
    # The cache that the user named is used, and not Calibray's, which has the program.
    assert named == [value, 0, misses]
    assert list(user.iterdir())


def test_settings_are_those_of_one_thread() -> None:
    inside, leave, types = threading.Barrier(3), threading.Barrier(3), {}

    def compute(name: str) -> None:
        with jax_settings():
            inside.wait()
            types[name] = str(jnp.ones(3).dtype)
            leave.wait()

    threads = [threading.Thread(target=compute, args=(name,)) for name in ("first", "second")]
    for thread in threads:
        thread.start()
    inside.wait()
    types["user"] = str(jax.jit(lambda: jnp.zeros(3))().dtype)
    leave.wait()
    for thread in threads:
        thread.join()
    assert types == {"first": "float64", "second": "float64", "user": "float32"}
    assert compilation_cache._cache is None


def test_settings_are_restored_after_an_error() -> None:
    with pytest.raises(KeyboardInterrupt), jax_settings():
        raise KeyboardInterrupt
    assert not jax.config.jax_enable_x64
    assert jax.config.jax_compilation_cache_dir is None
    assert compilation_cache._cache is None


def test_a_platform_without_a_device_is_refused(tmp_path: Path) -> None:
    program = (
        "from calibray.errors import InputError\nfrom calibray.fields import jax_settings\ntry:\n"
        "    with jax_settings():\n        pass\nexcept InputError as error:\n    print(error)"
    )
    said = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "JAX_PLATFORMS": "rocm"},
        capture_output=True,
        text=True,
    )
    assert "JAX finds no device to compute on (JAX_PLATFORMS = 'rocm')" in said.stdout, said.stderr
