"""How often the planted values lie in their 95 % intervals, over seeds of the three example walks.

    python benchmarks/bring_your_own.py [--walks town flat hill] [--seeds 30] [--first 1000] [--keep-faint] [--biased]
        [--out intervals.jsonl]

Every seed is a new walk through the places of `examples/bring_your_own`, with new position errors and new fading.
`calibray init` drafts the study, `calibray scene` makes the scene, and the calibration is that of `calibray run`. For
each stop in the town, the position is one of a few, and so is the track on the hill, so that all links are traced and
compiled only once. --keep-faint fits all averages above the noise floor; --biased does not correct the bias of the
logarithm of a mean. Both options apply to the town, which has a noise floor. Seeds that --out already contains are not
run again.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest

EXAMPLES = Path(__file__).parents[1] / "examples" / "bring_your_own"
sys.path.insert(0, str(EXAMPLES))

import make_flat as flat  # noqa: E402
import make_hill as hill  # noqa: E402
import make_town as town  # noqa: E402

from calibray import engines  # noqa: E402
from calibray.fitting.preliminary_fits import leave_out_near_floor  # noqa: E402
from calibray.fitting.problem import Problem  # noqa: E402
from calibray.fitting.search import choose, search  # noqa: E402
from calibray.measurements import (  # noqa: E402
    Averaging,
    LinkColumns,
    Measurements,
    Preparation,
    SourceTable,
    measured_links,
)
from calibray.scenes.authoring import (  # noqa: E402
    lower_origin,
    make_plan_scene,
    make_scene,
    read_footprints,
    read_openstreetmap,
    read_plan,
    read_terrain,
)
from calibray.study import Setup, Study  # noqa: E402
from calibray.study.draft import Given, draft  # noqa: E402
from calibray.uncertainty.assessment import certainty  # noqa: E402
from finished_runs import append_run, read_runs  # noqa: E402

CHOICES = 4  # recorded positions to draw from for each stop of the town
TRACKS = 3  # tracks along the hill
MARGIN = 50.0  # [m], width of the ground around the houses, as in `calibray scene`


@dataclass(frozen=True)
class Walk:
    """A place with a known truth.

    Attributes:
        planted: The true constants by parameter.
        problem: Function that returns the problem of the walk of a seed.
    """

    planted: dict[str, float]
    problem: Callable[[int], Problem]


def constants(materials: dict[str, dict[str, float]]) -> dict[str, float]:
    """Constants of the materials by parameter name."""
    return {f"{name}.{key}": value for name, values in materials.items() for key, value in values.items()}


# The town: all positions that may be recorded are links of one problem. A walk gives weight to those drawn and
# received.


def town_walk(folder: Path, biased: bool) -> Walk:
    """The town, its phones and its noise floor."""
    found, frame = read_openstreetmap(EXAMPLES / "town.osm", town.FRAME)
    places, gains = town.stopped(make_scene(found, folder / "planted", frame).path)
    # The user's scene is made without knowledge of the true frame.
    found, frame = read_openstreetmap(EXAMPLES / "town.osm")
    scene = make_scene(found, folder, frame).path

    def placed(points: np.ndarray) -> np.ndarray:
        degrees = town.FRAME.to_geographic(points)
        return frame.to_scene(degrees[:, 0], degrees[:, 1], 0.0) + np.outer(points[:, 2], [0, 0, 1])

    rng = np.random.default_rng(2026)
    shape = (len(town.PHONE_DB), len(places), CHOICES)
    recorded = np.zeros((*shape, 3)) + places[:, None]
    recorded[..., :2] += rng.normal(0.0, town.GPS_ERROR, (*shape, 2))
    recorded = placed(recorded.reshape(-1, 3)).reshape(recorded.shape)
    study = draft(
        str(scene),
        EXAMPLES / "rsrp.csv",
        folder / "study.toml",
        Given(EXAMPLES / "cells.csv", frequency=town.FREQUENCY),
    ).study
    count = recorded.size // 3
    links = Measurements(
        tx=np.repeat(placed(np.array(list(town.MASTS.values()))), count, axis=0),
        rx=np.tile(recorded.reshape(-1, 3), (len(town.MASTS), 1)),
        path_loss_db=np.full(count * len(town.MASTS), -town.FLOOR_DBM),
        group=np.repeat(
            [f"{cell} {phone}" for cell in town.MASTS for phone in town.PHONE_DB], count // shape[0]
        ),
        limit_db=np.full(count * len(town.MASTS), -town.FLOOR_DBM),
    )
    setup = Setup.open(study, links=links)
    whole = Problem.of(setup, engines.make(setup))
    if study.links.average is None:
        raise RuntimeError("the drafted study averages nothing")
    materials = {"walls": town.WALLS, "ground": town.GROUND}
    planted = {name: value for name, value in constants(materials).items() if "permittivity" in name}
    averaging = Averaging("cell", study.links.average.size, unbiased=not biased)
    return Walk(planted, lambda seed: _received_in_town(whole, gains, recorded, seed, averaging))


def _received_in_town(
    problem: Problem, gains: list[list[np.ndarray]], recorded: np.ndarray, seed: int, averaging: Averaging
) -> Problem:
    """The problem of one walk, in which only the positions drawn and received have weight."""
    rng = np.random.default_rng(seed)
    number = np.arange(len(problem.setup.links)).reshape(len(town.MASTS), *recorded.shape[:3])
    rows = []
    for stop in range(recorded.shape[1]):
        for phone, (name, gain_db) in enumerate(town.PHONE_DB.items()):
            choice = rng.integers(CHOICES)
            for _ in range(town.SAMPLES):
                for mast, (cell, eirp) in enumerate(town.EIRP_DBM.items()):
                    power = town.sample(gains[mast][stop], eirp + gain_db, rng)
                    loud = round(power, 1) if power > town.FLOOR_DBM else None
                    place = recorded[phone, stop, choice]
                    rows.append((number[mast, phone, stop, choice], cell, name, *place, loud))
    log = pd.DataFrame(rows, columns=["link", "cell", "device", "x", "y", "z", "rsrp"])
    steps = Preparation(noise_floor_dbm=town.FLOOR_DBM, averaging=averaging, keep=("cell", "device"))
    columns = LinkColumns((0.0, 0.0, 0.0), ("x", "y", "z"), "rsrp", "rsrp")
    table = measured_links(SourceTable(log, source="log"), columns, steps).frame
    measured, weight = np.array(problem.objective.measured), np.zeros(number.size)
    measured[table["link"]], weight[table["link"]] = -table["rsrp"], 1.0
    weight[problem.objective.weight == 0] = 0.0
    return replace(problem, objective=replace(problem.objective, measured=measured, weight=weight))


# The flat and the hill: the same positions with new values, read from files like those of a user.


def _again(study: Study, problem: Problem) -> Problem:
    """The problem with the values that the study's table now contains."""
    links = study.measurements()
    if not np.array_equal(links.rx, problem.setup.links.rx):
        raise RuntimeError("the links differ from those that were traced")
    return replace(problem, objective=replace(problem.objective, measured=links.path_loss_db))


def flat_walk(folder: Path) -> Walk:
    """The flat, its laptop and three access points; floor and ceiling have the constants of `calibray scene`."""
    gains = flat.received()
    scene = make_plan_scene(read_plan(flat.FOLDER / "plan.csv", 2.6), folder).path
    table = folder / "rss.csv"
    flat.measure(gains, np.random.default_rng(flat.SEED)).to_csv(table, index=False)
    study = draft(
        str(scene),
        table,
        folder / "study.toml",
        Given(flat.FOLDER / "access_points.csv", frequency=flat.FREQUENCY),
    ).study
    setup = study.opened()
    whole = Problem.of(setup, engines.make(setup))
    others = {
        name: {"relative_permittivity": each.relative_permittivity, "conductivity": each.conductivity}
        for name, each in setup.scene.materials.items()
        if name in ("floor", "ceiling")
    }

    def problem(seed: int) -> Problem:
        flat.measure(gains, np.random.default_rng(seed)).to_csv(table, index=False)
        return _again(study, whole)

    return Walk(constants(flat.PLANTED | others), problem)


def hill_walk(folder: Path) -> Walk:
    """The hill, its scanner and its track."""
    gains = hill.received()
    found, frame = read_footprints(hill.FOLDER / "houses.geojson", "height_m")
    bounds = found.bounds + MARGIN * np.array([-1, -1, 1, 1])
    terrain, frame = lower_origin(read_terrain(hill.FOLDER / "ground.tif", frame, bounds), frame)
    scene = make_scene(found, folder, frame, terrain).path

    @cache
    def tracked(number: int) -> tuple[Study, Problem]:
        place = folder / f"track-{number}"
        place.mkdir()
        rng = np.random.default_rng([2026, number])
        (place / "walk.gpx").write_text(hill.track(rng))
        hill.measure(gains, rng).to_csv(place / "power.csv", index=False)
        study = draft(
            str(scene), place / "power.csv", place / "study.toml",
            Given(hill.FOLDER / "masts.csv", place / "walk.gpx", frequency=hill.FREQUENCY),
        ).study  # fmt: skip
        setup = study.opened()
        return study, Problem.of(setup, engines.make(setup))

    def problem(seed: int) -> Problem:
        study, whole = tracked(seed % TRACKS)
        hill.measure(gains, np.random.default_rng(seed)).to_csv(study.links_path, index=False)
        return _again(study, whole)

    planted = {name: value for name, value in constants(hill.PLANTED).items() if "permittivity" in name}
    return Walk(planted, problem)


def judged(walk: Walk, seed: int, keep_faint: bool) -> dict[str, object]:
    """The outcome of the walk of a seed."""
    problem = walk.problem(seed)
    problem = problem if keep_faint else leave_out_near_floor(problem)
    trail = search(problem, choose(problem))
    record = certainty(problem, trail).record.intervals
    best = problem.parameters.named(trail.best)
    found = {
        name: {
            "planted": planted,
            "found": best[name],
            "pieces": [list(piece) for piece in record[name].pieces],
            "verdict": str(record[name].verdict),
        }
        for name, planted in walk.planted.items()
    }
    return {"links": problem.objective.num_counted, "rmse_db": trail.best_rmse_db, "parameters": found}


def holds(record: dict[str, object]) -> bool:
    """Whether an interval contains the planted value."""
    return any(low <= record["planted"] <= high for low, high in record["pieces"])


def summary(entries: list[dict[str, object]]) -> Iterator[str]:
    """How many intervals contain the planted value, one line for each walk and parameter."""
    for walk in dict.fromkeys(entry["walk"] for entry in entries):
        mine = [entry["parameters"] for entry in entries if entry["walk"] == walk]
        for name in mine[0]:
            records = [each[name] for each in mine]
            count, sure = (
                sum(map(holds, records)),
                [each for each in records if each["verdict"] == "identified"],
            )
            middle = np.median([each["found"] for each in records])
            likely = binomtest(count, len(records)).proportion_ci()
            yield (
                f"{walk}, {name}: {records[0]['planted']:.4g} in {count} of {len(records)} intervals, "
                f"{count / len(records):.2f} ({likely.low:.2f} to {likely.high:.2f}), of those called identified in "
                f"{sum(map(holds, sure))} of {len(sure)}; median estimate {middle:.4g}"
            )


def main() -> None:
    """Run the missing seeds, and print how many intervals contain the planted value."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--walks", nargs="+", default=["town", "flat", "hill"], choices=["town", "flat", "hill"]
    )
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--keep-faint", action="store_true")
    parser.add_argument("--biased", action="store_true")
    parser.add_argument("--out", type=Path, help="file of the outcomes; an interrupted run continues from it")
    arguments = parser.parse_args()
    how = {"keep_faint": arguments.keep_faint, "biased": arguments.biased}
    known = {(entry["walk"], entry["seed"]): entry for entry in read_runs(arguments.out, {"how": how})}
    entries = []
    for name in arguments.walks:
        with tempfile.TemporaryDirectory() as folder:
            walk = None
            for seed in range(arguments.first, arguments.first + arguments.seeds):
                if (name, seed) not in known:
                    makers = {
                        "town": lambda place: town_walk(place, arguments.biased), "flat": flat_walk, "hill": hill_walk,
                    }  # fmt: skip
                    walk = walk or makers[name](Path(folder))
                    record = {
                        "walk": name,
                        "seed": seed,
                        "how": how,
                        **judged(walk, seed, arguments.keep_faint),
                    }
                    known[name, seed] = record
                    append_run(arguments.out, record)
                entry = known[name, seed]
                entries.append(entry)
                shown = (
                    f"{parameter} {each['found']:.4g}{'' if holds(each) else ' NOT HELD'}"
                    for parameter, each in entry["parameters"].items()
                )
                print(
                    f"{name} {seed}: {entry['links']} links, {entry['rmse_db']:.2f} dB; {'; '.join(shown)}",
                    flush=True,
                )
    for line in summary(entries):
        print(line)


if __name__ == "__main__":
    main()
