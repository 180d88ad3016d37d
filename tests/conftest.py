"""What all tests share: reproducible property tests, one cache of compiled code, no lines of progress."""

# ruff: noqa: E402  (what NumPy reads has to be set before it is imported)

import gc
import os
import sys
from collections.abc import Iterator

# Matrices of the tests are small, and BLAS threads that wait for each other cost more than they gain. NumPy and SciPy
# read these when they are imported; subprocesses inherit them.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

# Some environments forbid bytecode; then every process that a test starts would compile all of Calibray again.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Tables as they are written to files, whatever the width of the terminal.
os.environ.pop("COLUMNS", None)

import jax
import pytest
from hypothesis import settings

from calibray.cli import console
from calibray.engines.replay import BATCH
from calibray.fields import program as programs
from calibray.fitting import cheap_replay, search
from calibray.support import cache_folder as caching
from calibray.uncertainty import buildings, richer_paths
from calibray.uncertainty import sequential_monte_carlo as sampler

# Every run draws the same examples, and a busy machine fails no test.
settings.register_profile("calibray", derandomize=True, deadline=None)
settings.load_profile("calibray")


def pytest_configure(config: pytest.Config) -> None:
    """What XLA compiles is kept in pytest's cache: workers share it, and the next run takes it from there."""
    kept = getattr(config, "cache", None)  # not there with -p no:cacheprovider
    if kept is not None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(caching.CACHE_VARIABLE, str(kept.mkdir("calibray")))
            from calibray.fields import jax_settings

            # the folder of compiled programs is chosen when Calibray computes first
            with jax_settings():
                pass


LONGEST = (
    "test_browser", "test_report_browser", "test_scenarios", "test_fidelity", "test_notebooks", "test_walk",
    "test_dask", "test_tracing", "test_calibrate", "test_assessment", "test_coefficient_tables", "test_carriers",
    "test_export", "test_adaptive_sampling", "test_tracer_protocol", "test_demo", "test_comparison", "test_ledger",
    "test_observables", "test_suggest", "test_derivatives", "test_octave", "test_unreached_links",
    "test_program_with_rays",
)  # fmt: skip
"""Files that take longest. They run first, so that no worker is left with one of them at the end."""


def pytest_collection_finish() -> None:
    """The garbage collector need not go through imported modules, which stay: a million objects."""
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first; `make test` keeps this order, where xdist would put files of few tests last."""
    rank = {name: index for index, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture(scope="session", autouse=True)
def _no_lines_of_progress():
    """No lines of progress on stderr, however busy the machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(console, "LINE_INTERVAL", 1e6)
        yield


FEW_CANDIDATES = {
    "fields", "prediction", "study", "tracing",
    "test_carriers", "test_chunks", "test_dask", "test_engines", "test_local_workers", "test_notebooks",
    "test_observable", "test_observed_links", "test_pose", "test_program_with_rays", "test_random_effects",
    "test_ray_mapping", "test_ray_readers", "test_rays", "test_repeats", "test_richer_paths", "test_shared_out",
    "test_unreached_links", "test_walk",
}  # fmt: skip
"""Rooms and files whose tests evaluate few candidates, so that compiling takes most of their time."""


@pytest.fixture(scope="module", autouse=True)
def _compiled_fast(request: pytest.FixtureRequest) -> Iterator[None]:
    """XLA optimizes nothing if few candidates are evaluated, nor does it in processes that these tests start.

    Posterior draws are evaluated in batches of a search's size, which need no program of their own.
    """
    if not {request.path.parent.name, request.path.stem} & FEW_CANDIDATES:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs, "SMALL", sys.maxsize)
        patch.setattr(buildings, "BATCHES", (1, BATCH))
        patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
        jax.config.update("jax_disable_most_optimizations", True)
        yield
        jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="session", autouse=True)
def _same_kernels(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Scenes share the ray tracer's kernels, if test files import it."""
    kept = None
    if "calibray.tracing.sionna" in sys.modules:
        from kernels import last_of_many

        kept = last_of_many(tmp_path_factory.mktemp("kernels"))
    yield
    del kept


@pytest.fixture(scope="session", autouse=True)
def _few_starts() -> Iterator[None]:
    """An eighth of the starting points of a search; small problems have few minima."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "STARTS", (16, 64))
        yield


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests of a file share their traces; nothing is taken from the user's cache or left there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(caching.CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


JUDGING_INTERVALS = {
    "benchmarks", "validation", "test_buildings", "test_censoring", "test_emulator", "test_linear_theory",
    "test_noise_models", "test_sequential_monte_carlo",
}  # fmt: skip
"""Rooms and files whose tests judge intervals; they draw as much as a user's run, but for its last sweeps."""

FEW = {"SIZE": (64, 64), "POPULATIONS": (2, 4), "SWEEPS": 1, "LAST_SWEEPS": (2, 2)}
MANY = {name: getattr(sampler, name) for name in FEW} | {"LAST_SWEEPS": (8, 8)}


def _draw(constants: dict[str, object]) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in constants.items():
            patch.setattr(sampler, name, value)
        yield


@pytest.fixture(scope="module", autouse=True)
def _few_draws(request: pytest.FixtureRequest) -> Iterator[None]:
    """A tenth of the draws from the posterior, which take most of the time of a small calibration."""
    judging = {request.path.parent.name, request.path.stem} & JUDGING_INTERVALS
    yield from _draw(MANY if judging else FEW)


@pytest.fixture(scope="module", autouse=True)
def _no_further_paths(request: pytest.FixtureRequest) -> Iterator[None]:
    """No trace for paths that a study leaves out, but in the tests of what such a trace is for."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (cheap_replay, richer_paths):
            if request.path.stem != f"test_{module.__name__.rpartition('.')[2]}":
                patch.setattr(module, "LONGEST_TRACE", 0.0)
        yield


@pytest.fixture
def all_draws() -> Iterator[None]:
    """As many draws as in the tests that judge intervals, for a test in another file."""
    yield from _draw(MANY)


@pytest.fixture
def few_draws() -> Iterator[None]:
    """As few draws as in other files, for a test that judges no interval in a file of tests that do."""
    yield from _draw(FEW)
