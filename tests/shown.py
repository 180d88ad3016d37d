"""Records as the command line shows them, from a stored result and made-up numbers; nothing is traced."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

import synthetic
from calibray.calibration.result import Result
from calibray.comparison.comparison import Comparison
from calibray.comparison.demo import Demo
from calibray.comparison.method_runs import BudgetedMethod, MethodRun
from calibray.doctor import Check, Diagnosis
from calibray.paths import Kind, Paths
from calibray.study import Study
from calibray.tracing.convergence import Convergence
from calibray.tracing.llvm import Llvm
from changed import changed

GOLDEN = Path(__file__).parent / "golden"
ROWS = np.arange(2, 32)
"""Lines of the links of `paths` and `convergence` in their source file."""


def result() -> Result:
    """A calibration of four parameters with an offset per half and a hold-out, one link without a path."""
    # The golden files are edited by hand.
    return Result.load(GOLDEN / "result", allow_changed_inputs=True)


def bare_result() -> Result:
    """The same from an engine without derivatives, nothing held out, with what else may be there or not."""
    full = result()
    study = Study.from_content(
        full.study.content()
        | {"objective": {"no_path": "censor", "ceiling_db": 140.0}, "offset": None, "holdout": None},
        "bare.toml",
    )
    return changed(
        full,
        study=study,
        fallback=None,
        intervals={},
        coefficients={},
        nuisance_only_rmse_db=None,
        holdout_rmse_db=None,
        initial_holdout_rmse_db=None,
        log_distance_holdout_rmse_db=None,
        retrace_gap_db=0.314,
        rt_calls=12_345,
        ledger_hits=1_200,
    )


def paths() -> Paths:
    """Paths to five of thirty links."""
    return replace(
        synthetic.program([(), (Kind.SPECULAR,), (Kind.SPECULAR, Kind.DIFFUSE)] * 5, links=30),
        link=np.repeat(np.arange(5), 3).astype(np.int32),
    )


def convergence() -> Convergence:
    """A trace of thirty links that more samples change, one gained and one lost among them."""
    change = np.random.default_rng(5).normal(0, 0.3, 30).round(3)
    change[[3, 8]] = np.inf, -np.inf
    before = np.full(30, 1200)
    return Convergence(500_000, change, before, before + np.random.default_rng(6).integers(-2, 3, 30))


def comparison() -> Comparison:
    """Four methods from three seeds, one of which failed and one never came near."""
    methods = tuple(
        BudgetedMethod.parse(name, 225)
        for name in ("sgwo-im", "gwo@600", "gaussian-process", "least-squares")
    )
    random = np.random.default_rng(4)

    def run(method: BudgetedMethod, seed: int) -> MethodRun:
        calls = tuple(sorted(random.choice(np.arange(1, method.budget + 1), 9, replace=False).tolist()))
        best = tuple((2.0 + np.sort(10.0 ** random.uniform(-4, 1, 9))[::-1]).tolist())
        return MethodRun(method.method, method.budget, seed, method.budget, calls, best, 0.5 + seed)

    runs = {method.name: tuple(run(method, seed) for seed in range(3)) for method in methods}
    runs["gaussian-process"] = (
        *runs["gaussian-process"][:2],
        MethodRun("gaussian-process", 225, 2, 0, (), (), 0.1, "LinAlgError: not positive definite"),
    )
    return Comparison("street", methods, runs, 2.0, "least-squares from 2048 starts")


def demo() -> Demo:
    """The paper's experiment with made-up results."""
    full = result()
    names = ("concrete", "glass", "soil")
    old = list(full.parameters)[:3]
    renamed = {f"{name}.relative_permittivity": key for name, key in zip(names, old, strict=True)}

    def found(calls: int, rmse_db: float, shift: float) -> Result:
        return changed(
            full,
            rt_calls=calls,
            rmse_db=rmse_db,
            seconds=calls / 100,
            parameters={name: full.parameters[key] + shift for name, key in renamed.items()},
            initial_parameters={name: full.fit.initial_parameters[key] for name, key in renamed.items()},
            intervals={name: full.intervals[key] for name, key in renamed.items()},
        )

    results = {"gwo": found(600, 3.1, 0.5), "sgwo-im": found(225, 3.02, 0.2), "auto": found(131, 2.97, 0.0)}
    return Demo(results, 2.97, {"concrete": 6.0, "glass": 4.4, "soil": 4.0}, "replay", 3.2)


def diagnosis() -> Diagnosis:
    """A machine on which one check failed."""
    return Diagnosis(
        versions=(("python", "3.11.2"), ("pyarrow", "not installed: pip install 'calibray[parquet]'")),
        variant="llvm_ad_mono_polarized",
        cuda_devices=0,
        libraries=(
            Llvm("/usr/lib/libLLVM.so.19.1", (19, 1, 7), None),
            Llvm("/usr/lib/libLLVM-15.so.1", (15,), "LLVM 15 is too old"),
        ),
        checks=(
            Check("LLVM", True, "19.1.7", "install LLVM"),
            Check("JAX", False, "no module [jax]", "pip install jax"),
        ),
    )


def calls() -> pd.DataFrame:
    """A ledger's table of three RT calls, one of which failed."""
    return pd.DataFrame(
        {
            "problem": ["0123456789ab"] * 3,
            "engine": ["command"] * 3,
            "time": ["2026-01-02 03:04:05", "2026-01-02 03:04:06", "2026-01-02 03:04:07"],
            "seconds": [0.51234567, 12.0, 3.25],
            "status": ["ok", "failed", "ok"],
            "message": ["", "the program ended with 3\nits last words", ""],
            "walls.relative_permittivity": [3.0, 4.123456789, 1e-7],
        }
    )
