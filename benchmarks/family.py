"""Every method on families of planted problems at equal budgets of RT calls (docs/measurements/methods-on-families.md).

    python benchmarks/family.py --workers 2                      # development: seeds 0 to 19
    python benchmarks/family.py --seeds 5000:5020 --workers 2    # judging: run once, reported whatever the result

needs `pip install "calibray[optimizers,scenes]"` and a tracer. Every finished run is stored under out/family at once; a
killed benchmark continues where it stopped, and one with more seeds, methods or `--repeats` runs only what is missing.
Problems that cannot be made and failed runs are listed below the tables. Excess RMSE can be compared between machines,
but times cannot.
"""

# ruff: noqa: E402  (the number of threads has to be set before NumPy is imported)
from __future__ import annotations

import argparse
import os
from pathlib import Path

for library in (
    "OMP",
    "OPENBLAS",
    "MKL",
):  # read when NumPy is loaded; one core per run, here and in the workers
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

from calibray.cli.console import log, progress_bars
from calibray.comparison.comparison import quantile
from calibray.optimizers import label
from calibray.tables import Column, Table, numbers
from markdown_tables import render_markdown
from problem_families.family_comparison import FamilyComparison, compare_family, seed_range, tables

ROOT = Path(__file__).resolve().parents[1]
METHODS = (
    "space-mapping@30", "vector-surrogate", "sgwo-im", "gwo", "gaussian-process", "cma-es",
    "differential-evolution", "dfo-ls", "random", "latin-hypercube", "sobol",
)  # fmt: skip

AUTO = "vector-surrogate"  # what `auto` uses without a cheap model
DIGIT_DB = 1e-4  # the last digit of the tables; medians this close count as equal


def main() -> None:
    """Run what is missing and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--families", nargs="+", default=["district", "office"])
    parser.add_argument("--seeds", default="0:20")
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--budget", type=int, default=225)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument(
        "--constants", choices=("right", "wrong"), help="only problems whose cheap model has such constants"
    )
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--runs", type=Path, default=ROOT / "out/family", help="folder of the finished runs")
    chosen = parser.parse_args()
    wrong_constants = None if chosen.constants is None else chosen.constants == "wrong"
    finished = []
    for kind in chosen.families:
        with progress_bars(log()) as progress:
            part = compare_family(
                kind, seed_range(chosen.seeds), chosen.methods, budget=chosen.budget, repeats=chosen.repeats,
                out=chosen.runs, workers=chosen.workers, progress=progress, wrong_constants=wrong_constants,
            )  # fmt: skip
        finished.append(part)
    together = FamilyComparison.joined(finished)
    named = [(part.kind, part) for part in (finished if len(finished) == 1 else [*finished, together])]
    for constants, problems in (("right", ~together.wrong_constants), ("wrong", together.wrong_constants)):
        part = together.part(problems)
        if part.seeds:
            named.append((f"{together.kind}, cheap models with {constants} constants", part))
    for name, part in named:
        print(f"## {name}: {len(part.seeds)} problems\n")
        for table in tables(part):
            print(f"{table.title}\n\n{render_markdown(table)}\n", flush=True)
    print(f"{render_markdown(shown(together))}\n")
    for part in finished:
        for seed, reason in part.failed_problems:
            print(f"- {part.kind} {seed} could not be made: {reason}")
        for name, seed, failure in part.failures():
            print(f"- {part.kind} {seed}, {name}: a run failed: {failure}")


def shown(comparison: FamilyComparison) -> Table:
    """The targets of the methods that were run, with the measured values."""
    by_method = {budgeted.method: budgeted for budgeted in comparison.methods}
    rows: list[tuple[str, str, str, str]] = []

    def measured(method: str, calls: int, share: float = 0.5) -> float:
        return quantile(comparison.excess(by_method[method].name, calls).ravel(), share)

    def row(what: str, wanted: str, value: float, met: bool) -> None:
        rows.append((what, wanted, f"{value:.4f}", "yes" if met else "no"))

    if {"space-mapping", "sgwo-im"} <= by_method.keys():
        paper, ours = measured("sgwo-im", 225), measured("space-mapping", 8)
        row("space mapping, median at 8 [dB]", f"SGWO-IM's at 225: {paper:.4f}", ours, ours <= paper)
    if "space-mapping" in by_method:
        tail = measured("space-mapping", 8, 0.9)
        row("space mapping, 90th percentile at 8 [dB]", "below 0.05", tail, tail < 0.05)
        for constants, chosen, calls in (
            ("right", ~comparison.wrong_constants, 15),
            ("wrong", comparison.wrong_constants, 30),
        ):
            if chosen.any() and calls <= by_method["space-mapping"].budget:
                share = comparison.part(chosen).solved(by_method["space-mapping"].name, calls, 0.02)
                what = (
                    f"space mapping, cheap model with {constants} constants, share within 0.02 dB at {calls}"
                )
                row(what, "at least 0.8", share, share >= 0.8)
    without = [name for name in by_method if name != "space-mapping"]
    for calls in (30, 60, 120, 225):
        median = {name: measured(name, calls) for name in without if calls <= by_method[name].budget}
        if AUTO in median and len(median) > 1:
            others = {name: value for name, value in median.items() if name != AUTO}
            rival = min(others, key=lambda name: others[name])
            wanted = f"{label(rival)}'s: {others[rival]:.4f}"
            met = median[AUTO] <= others[rival] + DIGIT_DB
            row(f"{label(AUTO)}, median at {calls} [dB]", wanted, median[AUTO], met)
    columns = (Column("what"), Column("wanted"), numbers("measured"), Column("met"))
    return Table("", columns, tuple(rows))


if __name__ == "__main__":
    main()
