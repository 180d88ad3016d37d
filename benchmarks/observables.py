"""Planted delay spreads and round-trip times: do they determine what path loss cannot, with intervals that hold?

    python benchmarks/observables.py --districts 20 --repetitions 5
    python benchmarks/observables.py --receiver

Every district of antenna_pose.py gets diffuse walls and 40 links in sight along two streets. A repetition draws the
permittivity and the scattering coefficient S of the walls, computes path loss and RMS delay spread, adds noise of 3 dB
and 3 ns, and calibrates on path loss alone and on both, with an unknown offset of path loss. The table shows how often
S is identified, and how often the 90 % intervals of the draws cover the truth. A third run uses the delay spreads of
the next district. The last lines show how often a conflict is reported with these and with the correct ones.

Every office has five access points, each with an unknown bias of its round-trip times. A repetition draws two
permittivities and the biases, and calibrates on path loss and round-trip times (80 MHz, 8 ns of noise). The table shows
how often the 90 % interval of a bias covers its true value.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import jax
import numpy as np
import pandas as pd
from scipy.special import stdtrit

import calibray as cb
import calibray.fields.observables as receiver
from antenna_pose import POSITION, district
from calibray import engines
from calibray.engines import Replay
from calibray.engines.kinds.replay import replay
from calibray.fitting.preliminary_fits import estimate_noise
from calibray.fitting.problem import Problem
from calibray.fitting.search import choose, search
from calibray.measurements.observables import Statistic
from calibray.result.verdict import Remark, RemarkKind
from calibray.scenes import Mesh, MeshObject, write_scene
from calibray.study import Setup, Study
from calibray.uncertainty.remarks import conflict

NOISE_DB: Final = 3.0
NOISE_NS: Final = 3.0
BOUNDS: Final = {"walls.relative_permittivity": [2.0, 9.0], "walls.scattering_coefficient": [0.0, 0.95]}
DRAWN: Final = {"walls.relative_permittivity": (3.0, 8.0), "walls.scattering_coefficient": (0.2, 0.8)}
REPORTED: Final = {RemarkKind.CONFLICT}
SPREAD: Final = {"kind": "rms_delay_spread", "column": "spread_ns", "unit": "ns"}
Row = dict[str, Any]
NOISE_RTT_NS: Final = 8.0
"""Standard deviation of a round-trip time, equivalent to 1.2 m of distance."""
ROUND_TRIP: Final = Statistic("round_trip_time", "first", dynamic_range_db=20.0, bandwidth=80e6)
RTT: Final = {
    "kind": "round_trip_time", "column": "rtt_ns", "unit": "ns", "bias": "access_point", "path": "first",
    "dynamic_range_db": 20.0, "bandwidth": 80e6,
}  # fmt: skip
OFFICE: Final = ("walls.relative_permittivity", "slabs.relative_permittivity")
LINKS: Final = 40
"""Links of a district, along two of its streets."""
SAMPLES: Final = 400
"""Rays per transmitter; truth and calibration share the paths."""
QUICK: Final = {"noise": {"kind": "gaussian", "range_m": 0, "heterogeneity": 0, "constants_spread": 0}}
"""The planted noise: one noise model instead of all."""


def streets(folder: Path, seed: int) -> pd.DataFrame:
    """The scene of a district of antenna_pose.py with diffuse walls, and links in sight along two of its streets."""
    district(folder, seed)
    random = np.random.default_rng([seed, 28])
    street = np.repeat([-35.0, 35.0], LINKS // 2)
    tx = np.column_stack([street, np.full(LINKS, -80.0), np.full(LINKS, 4.0)])
    x, y = street + random.uniform(-8, 8, LINKS), random.uniform(-65, 90, LINKS)
    rx = np.column_stack([x, y, np.full(LINKS, 1.5)])
    return pd.DataFrame(np.hstack([tx, rx]).round(2), columns=POSITION).assign(loss_db=100.0)


def study(folder: Path, table: pd.DataFrame, **sections: Any) -> Study:
    """The study of a district's links."""
    table.to_csv(folder / "links.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": "scene/scene.xml", "frequency": 3.5e9},
        "links": {"file": "links.csv", "tx": POSITION[:3], "rx": POSITION[3:], "value": "loss_db"},
        "materials": {"walls": {"scattering_coefficient": 0.5}},
        "trace": {"max_depth": 2, "samples": SAMPLES, "diffuse_reflection": True},
        "parameters": {name: {"bounds": bounds} for name, bounds in BOUNDS.items()},
        "offset": {},
        "fidelity": {"rounds": 0},
        **QUICK,
    }
    return Study.from_content(content | sections, folder / "study.toml")


def planted(
    folder: Path, links: pd.DataFrame, random: np.random.Generator
) -> tuple[dict[str, float], pd.DataFrame]:
    """A draw of the truth, and the links with a path, with their noisy path loss and delay spread."""
    setup = Setup.open(study(folder, links))
    truth = {name: random.uniform(*limits) for name, limits in DRAWN.items()}
    engine = replay(setup, setup.trace())
    assert isinstance(engine, Replay)
    values = np.array([[truth[name] for name in engine.parameters.names]])
    loss = engine.path_loss(values)[0]
    spread = 1e9 * engine.respond(values, (Statistic("rms_delay_spread"),)).observed[0, 0]
    reached = np.isfinite(loss) & np.isfinite(spread)
    noise = random.standard_normal((2, len(links)))
    measured = links.assign(
        loss_db=loss + NOISE_DB * noise[0] + random.uniform(-5, 5), spread_ns=spread + NOISE_NS * noise[1]
    )
    return truth, measured[reached].reset_index(drop=True)


def district_runs(folder: Path, links: pd.DataFrame, other: pd.DataFrame, seed: list[int]) -> list[Row]:
    """Calibrate one draw of the truth on path loss, on both observables, and with another district's delay spreads."""
    random, rows = np.random.default_rng([*seed, 28]), []
    truth, table = planted(folder, links, random)
    _, elsewhere = planted(folder.with_name(f"{folder.name}-next"), other, random)
    foreign = table.assign(spread_ns=np.resize(elsewhere["spread_ns"].to_numpy(), len(table)))
    runs = {"both": {"observables": {"spread": SPREAD}}}
    # What path loss alone determines hardly depends on the draw, so a few runs are sufficient.
    runs |= {"path loss": {}} if seed[1] == 0 and seed[0] % 2 == 0 else {}
    for data, sections in runs.items():
        started = time.perf_counter()
        result = cb.calibrate(study(folder, table, **sections))
        common = {"data": data, "seed": tuple(seed), "seconds": time.perf_counter() - started}
        common["conflict"] = any(remark.kind in REPORTED for remark in result.uncertainty.remarks)
        for name, interval in result.intervals.items():
            low, high = np.quantile(result.uncertainty.draws[name], [0.05, 0.95])
            covered = bool(low <= truth[name] <= high)
            rows.append(
                common | {"parameter": name, "label": interval.label, "covered": covered, "width": high - low}
            )
    reported = bool(conflict_of(study(folder, foreign, observables={"spread": SPREAD})))
    return [*rows, {"data": "delays of another district", "seed": tuple(seed), "conflict": reported}]


def conflict_of(plan: Study) -> tuple[Remark, ...]:
    """The remarks on a conflict as in a calibration, but without posterior draws."""
    setup = Setup.open(plan)
    problem = estimate_noise(Problem.of(setup, engines.make(setup)))
    return conflict(problem, search(problem, choose(problem)).minima)


def office(folder: Path, seed: int) -> pd.DataFrame:
    """Write a floor of an office with random inner walls, and draw five access points with eight receivers each."""
    random = np.random.default_rng([seed, 82])
    width, depth, height = 32.0, 18.0, 3.0
    outer = [(0, 0, width, 0), (0, depth, width, depth), (0, 0, 0, depth), (width, 0, width, depth)]
    columns = [x + random.uniform(-2, 2) for x in (8.0, 16.0, 24.0)]
    inner = [(x, 0, x, random.uniform(6, 12)) for x in columns]
    inner += [(x, random.uniform(11, 14), x + 5, random.uniform(11, 14)) for x in (1.0, 11.0, 20.0)]
    walls = [
        MeshObject(f"wall-{k}", "walls", _sheet(line, height)) for k, line in enumerate([*outer, *inner])
    ]
    slabs = [MeshObject(f"slab-{k}", "slabs", _slab(width, depth, z)) for k, z in enumerate((0.0, height))]
    constants = {"relative_permittivity": 4.0, "conductivity": 0.05, "thickness": 0.1}
    write_scene(folder / "scene", [*walls, *slabs], {"walls": constants, "slabs": constants})
    tx = random.uniform((1, 1, 2.5), (width - 1, depth - 1, 2.8), (5, 3)).repeat(8, axis=0)
    rx = random.uniform((1, 1, 1.0), (width - 1, depth - 1, 1.5), (40, 3))
    table = pd.DataFrame(np.hstack([tx, rx]).round(2), columns=POSITION)
    return table.assign(access_point=np.repeat(list("abcde"), 8), loss_db=80.0)


def receiver_checks(folder: Path, links: pd.DataFrame) -> None:
    """Print the error of smooth limits relative to hard ones, and the time with and without further observables."""
    wanted = tuple(
        Statistic(kind, dynamic_range_db=range_db, bandwidth=bandwidth)
        for kind in ("rms_delay_spread", "mean_excess_delay")
        for range_db in (20.0, 30.0)
        for bandwidth in (None, 1e8)
    )
    setup = Setup.open(study(folder, links))
    engine = replay(setup, setup.trace())
    values = engine.parameters.from_unit(
        np.random.default_rng(1).uniform(0.1, 0.9, (8, len(engine.parameters)))
    )
    soft = engine.respond(values, wanted).observed
    with hard_limits():
        hard = engine.respond(values, wanted).observed
    for index, each in enumerate(wanted):
        error = 1e9 * np.abs(soft - hard)[:, index]
        typical = 1e9 * np.sqrt(np.nanmean(hard[:, index] ** 2))
        rms, largest = np.sqrt(np.nanmean(error**2)), np.nanmax(error)
        print(
            f"{each.kind}, {each.dynamic_range_db:g} dB, bandwidth {each.bandwidth}, {typical:.1f} ns: error of the"
        )
        print(f"  smooth limit {rms:.3f} ns (root mean square), {largest:.2f} ns (largest)")
    problem = Problem.of(setup, engine)
    points = problem.parameters.to_search(values)
    answer, direct = problem.evaluate(points, derivatives=True), engine.path_loss_and_jacobian(values)
    same = np.array_equal(answer.modelled, direct[0])
    times: dict[str, list[float]] = {}
    both = Problem.of(Setup.open(study(folder, links, observables={"spread": SPREAD})), engine)
    cases = {
        "engine": lambda: engine.path_loss_and_jacobian(values),
        "path loss alone": lambda: problem.evaluate(points, derivatives=True),
        "path loss and delay spread": lambda: both.evaluate(points, derivatives=True),
    }
    for _ in range(12):
        for name, case in cases.items():
            started = time.process_time()
            case()
            times.setdefault(name, []).append(time.process_time() - started)
    engine_time = float(np.median(times["engine"][2:]))
    ratios = {name: f"{np.median(each[2:]) / engine_time:.2f}" for name, each in times.items()}
    print(
        f"path loss alone: the digits of the engine {same}; time relative to the engine's path loss {ratios}"
    )


@contextmanager
def hard_limits() -> Iterator[None]:
    """Replace the smooth limits of the receiver with hard ones."""
    before = receiver.SOFT_DB
    vars(receiver)["SOFT_DB"] = 1e-4
    jax.clear_caches()
    try:
        yield
    finally:
        vars(receiver)["SOFT_DB"] = before
        jax.clear_caches()


def _sheet(line: tuple[float, ...], height: float) -> Mesh:
    x, y, x2, y2 = line
    corners = np.array([[x, y, 0], [x2, y2, 0], [x2, y2, height], [x, y, height]], dtype=float)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def _slab(width: float, depth: float, z: float) -> Mesh:
    corners = np.array([[0, 0, z], [width, 0, z], [width, depth, z], [0, depth, z]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def office_study(folder: Path, table: pd.DataFrame, **sections: Any) -> Study:
    """The study of an office's links on path loss and round-trip times."""
    table.to_csv(folder / "links.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": "scene/scene.xml", "frequency": 5.5e9},
        "links": {"file": "links.csv", "tx": POSITION[:3], "rx": POSITION[3:], "value": "loss_db"},
        "trace": {"max_depth": 3, "samples": 20_000, "refraction": True},
        "parameters": {name: {"bounds": [1.5, 9.0]} for name in OFFICE},
        "offset": {},
        "fidelity": {"rounds": 0},
        **QUICK,
    }
    return Study.from_content(content | sections, folder / "study.toml")


def office_runs(folder: Path, links: pd.DataFrame, seed: list[int]) -> list[Row]:
    """Calibrate one draw of materials and biases; a row per access point."""
    random = np.random.default_rng([*seed, 81])
    setup = Setup.open(office_study(folder, links))
    truth = np.array([[random.uniform(2.5, 7.0) for _ in OFFICE]])
    answer = replay(setup, setup.trace()).respond(truth, (ROUND_TRIP,))
    bias = {name: random.uniform(-40, 40) for name in "abcde"}
    noise = random.standard_normal((2, len(links)))
    table = links.assign(
        loss_db=answer.path_loss[0] + NOISE_DB * noise[0],
        rtt_ns=1e9 * answer.observed[0, 0] + links["access_point"].map(bias) + NOISE_RTT_NS * noise[1],
    )
    table = table[np.isfinite(answer.path_loss[0])].reset_index(drop=True)
    result = cb.calibrate(office_study(folder, table, observables={"rtt": RTT}))
    fit, rows = result.fit.observables["rtt"], []
    for name, value in fit.biases.items():
        error = fit.bias_errors[name]
        freedom = fit.links - len(fit.biases) - len(OFFICE)
        covered = abs(value - bias[name]) <= stdtrit(freedom, 0.95) * error
        rows.append(
            {
                "data": "office",
                "seed": tuple(seed),
                "parameter": "bias",
                "covered": bool(covered),
                "width": error,
            }
        )
    return rows


def report(rows: list[dict[str, Any]]) -> None:
    """Print the table and the shares of runs with remarks."""
    table = pd.DataFrame(rows)
    judged = table[table["parameter"].notna()]
    summary = judged.groupby(["data", "parameter"]).agg(
        count=("covered", "size"), coverage=("covered", "mean"),
        identified=("label", lambda labels: (labels == "identified").mean()),
        weakly=("label", lambda labels: (labels == "weakly identified").mean()),
        median_width=("width", "median"),
    )  # fmt: skip
    print(summary.round(3).to_string())
    runs = table[table["data"] != "office"].drop_duplicates(["data", "seed"])
    for data, reported in runs.groupby("data")["conflict"]:
        print(f"{data}: a conflict is reported in {int(reported.sum())} of {len(reported)} runs")


def main() -> None:
    """Run the repetitions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--districts", type=int, default=20)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="first district")
    parser.add_argument("--offices", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=np.inf, help="start no repetition after this time")
    parser.add_argument(
        "--receiver", action="store_true", help="measure only errors of smooth limits and time"
    )
    options = parser.parse_args()
    started, rows = time.perf_counter(), []
    with tempfile.TemporaryDirectory() as root:
        if options.receiver:
            folder = Path(root) / "receiver"
            receiver_checks(folder, streets(folder, options.first).assign(spread_ns=np.arange(LINKS)))
            return
        for number in range(options.repetitions):
            for seed in range(options.first, options.first + max(options.districts, options.offices)):
                here, there, rooms = (Path(root) / f"{seed}{end}" for end in ("", "-next", "-office"))
                if time.perf_counter() - started > options.seconds:
                    continue
                if seed < options.first + options.districts:
                    rows += district_runs(here, streets(here, seed), streets(there, seed + 1), [seed, number])
                if seed < options.first + options.offices:
                    rows += office_runs(rooms, office(rooms, seed), [seed, number])
                print(f"{seed} {number}: {time.perf_counter() - started:.0f} s", flush=True)
                if seed % 5 == 4:
                    report(rows)
    report(rows)


if __name__ == "__main__":
    main()
