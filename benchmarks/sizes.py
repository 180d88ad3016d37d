"""How the time to read a study grows with its parameters, as ratios.

    python benchmarks/sizes.py

With five times as many parameters, a step should take about five times as long; a quadratic step takes 25 times as
long.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

from calibray.materials import Material
from calibray.study import Study

FEW, MANY = 2_000, 10_000


def content(count: int, entries: dict[str, dict[str, object]]) -> dict[str, object]:
    """A study of many materials with several parameters each."""
    return {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": 3.5e9},
        "links": {"file": "links.csv", "tx": [0, 0, 1], "rx": ["x", "y", 1], "value": "loss"},
        "parameters": {
            f"wall-{k}.{field}": entry
            for k in range(count // len(entries))
            for field, entry in entries.items()
        },
    }


def seconds(work: Callable[[], object]) -> float:
    """The smallest time of three runs [s]."""
    times = []
    for _ in range(3):
        start = perf_counter()
        work()
        times.append(perf_counter() - start)
    return min(times)


def main() -> None:
    """Print a line for each step and kind of parameter."""
    kinds = {
        "constants": {"relative_permittivity": {"bounds": [1.5, 12.0]}},
        "laws": {
            "itu_a": {"bounds": [2.0, 6.0], "start": 3.0},
            "itu_b": {"bounds": [-0.1, 0.1], "start": 0.0},
        },
    }
    base = {f"wall-{k}": Material(5.0, 0.1, 0.3) for k in range(MANY)}
    print(f"{'':28}{FEW:>10,}{MANY:>10,}{'ratio':>8}")
    for kind, entries in kinds.items():
        rows: dict[str, list[float]] = {}
        for count in (FEW, MANY):
            given = content(count, entries)
            study = Study.from_content(given)
            parameters = study.parameter_set(base)
            steps: dict[str, Callable[[], object]] = {
                "study": lambda given=given: Study.from_content(given),
                "parameters": lambda study=study: study.parameter_set(base),
                "materials": lambda parameters=parameters: parameters.materials(parameters.start, base),
                "constants": lambda parameters=parameters: parameters.constants_of([parameters.start], base),
            }
            for step, work in steps.items():
                rows.setdefault(step, []).append(seconds(work))
        for step, (few, many) in rows.items():
            print(f"{kind + ', ' + step:28}{few:>9.3f}s{many:>9.3f}s{many / few:>8.1f}")


if __name__ == "__main__":
    main()
