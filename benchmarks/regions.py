"""A planted belt of trees: its estimated attenuation, the model that validation prefers, and the report's hint.

    python benchmarks/regions.py --districts 20 --repetitions 5
    python benchmarks/regions.py --lines --districts 20 --repetitions 5
    python benchmarks/regions.py --plain

Every district has buildings and two masts (`antenna_pose.district`). A repetition plants a belt of trees in a street,
10 to 16 m wide, 60 to 110 m long and 7 to 12 m high, with 0.3 to 1.5 dB/m, and two permittivities, computes the path
loss of 200 links, and adds 3 dB of noise. It calibrates on three quarters of the links, with the belt, whose
attenuation is a parameter, and without it. The receivers in a quarter of all squares of 40 m are held out. The table
shows how often the 90 % interval of the draws contains the planted attenuation, and how often the model with the belt
has the lower error on the held-out links. It also shows how often the report of the model without the belt hints at a
region of extra loss that covers a third of the belt or more, and how often it hints at a region if there are no trees
(first repetition in each district).

With `--lines`, only the search for a region is judged, on errors that the belts cause along straight lines, plus noise.
With `--plain`, the output is the ratio of the time of a replay of a study without regions to that of the bare
evaluation of the same program, and the largest difference in path loss, which must be 0.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import shapely

import calibray as cb
from antenna_pose import FREQUENCY, MATERIALS, NOISE_DB, POSITION, district
from calibray import engines, fields
from calibray.reporting.diagnostics import diagnostics
from calibray.scenes.obstruction import Region
from calibray.study import Setup, Study
from calibray.study.regions import RegionSection
from calibray.uncertainty.missing_region import missing_region

TREES: Final = "region:trees.specific_attenuation"
BOUNDS: Final = [0.0, 3.0]
SQUARE: Final = 40.0
"""Width of the squares whose receivers are held out together [m]."""
ONE_NOISE_MODEL: Final = {"kind": "gaussian", "range_m": 0, "heterogeneity": 0, "constants_spread": 0}
STREET: Final = 35.0
"""Distance of the streets from the centre of a district [m]."""


def study(folder: Path, table: pd.DataFrame, belt: dict[str, Any] | None, known: bool = True) -> Study:
    """The study of links, with or without a belt whose attenuation is a parameter.

    If the belt is unknown, its attenuation has the bounds 0 and 1e-9 dB/m. The same program, which is not compiled
    again, then gives the path loss of a scene without it.
    """
    table.to_csv(folder / "links.csv", index=False)
    parameters: dict[str, Any] = {name: {"bounds": bounds} for name, bounds in MATERIALS.items()}
    if belt:
        belt = belt if known else belt | {"specific_attenuation": 0.0}
        parameters[TREES] = {"bounds": BOUNDS if known else [0.0, 1e-9]}
    content = {
        "version": 1,
        "scene": {"file": "scene/scene.xml", "frequency": FREQUENCY},
        "links": {"file": "links.csv", "tx": POSITION[:3], "rx": POSITION[3:], "value": "loss_db"},
        "trace": {"max_depth": 2, "samples": 30_000, "diffraction": True},
        "holdout": {"where": "held_out == True"},
        "parameters": parameters,
        **({"regions": {"trees": belt}} if belt else {}),
        # Without the belt, only errors are judged, not intervals, so that one noise model is sufficient.
        **({} if known else {"noise": ONE_NOISE_MODEL}),
    }  # fmt: skip
    return Study.from_content(content, folder / "study.toml")


def planted_belt(random: np.random.Generator) -> tuple[dict[str, Any], float]:
    """A belt of trees along a street as a section of the study, and its attenuation [dB/m]."""
    middle, width = random.choice([-STREET, STREET]) + random.uniform(-2, 2), random.uniform(10, 16)
    length, start = random.uniform(60, 110), random.uniform(-90, 20)
    low, high = middle - width / 2, middle + width / 2
    along = random.random() < 0.5
    box = [low, start, high, start + length] if along else [start, low, start + length, high]
    section = {"boxes": [box], "top": random.uniform(7, 12), "specific_attenuation": 0.5}
    return section, random.uniform(0.3, 1.5)


def points_at(result: cb.Result, belt: shapely.Geometry) -> tuple[bool, bool]:
    """Whether the report of a result hints at a region of extra loss, and at one with a third of the belt or more."""
    found = diagnostics(result).get("missing_region")
    if found is None or not found["significant"].item():
        return False, False
    box = shapely.box(*(found[side].item() for side in ("west", "south", "east", "north")))
    return True, bool(shapely.area(shapely.intersection(box, belt)) > shapely.area(belt) / 3)


def reached(folder: Path, seed: int) -> pd.DataFrame:
    """The links of a new district that have a path."""
    links = district(folder, seed)
    setup = Setup.open(study(folder, links, None))
    return links[np.isfinite(fields.path_loss(setup.trace()))]


def repetition(folder: Path, links: pd.DataFrame, seed: list[int], bare: bool) -> dict[str, Any]:
    """Calibrate one draw of belt and materials with and without the belt; return a row of the table.

    With `bare`, the same materials are also measured without trees.
    """
    random, started = np.random.default_rng(seed), time.process_time()
    belt, attenuation = planted_belt(random)
    square = np.floor(links[["rx_x", "rx_y"]].to_numpy() / SQUARE).astype(int)
    _, number = np.unique(square, axis=0, return_inverse=True)
    held = random.permutation(number.max() + 1)[number.reshape(-1)] < (number.max() + 1) / 4
    links = links.assign(held_out=held)
    truth = {name: random.uniform(bounds[0] + 0.5, bounds[1] - 2.0) for name, bounds in MATERIALS.items()}
    truth[TREES] = attenuation
    setup = Setup.open(study(folder, links, belt))
    engine = engines.make(setup)
    loss = engine.path_loss(np.array([[truth[name] for name in setup.parameters.names]]))[0]
    truth[TREES] = 0.0
    unshaded = engine.path_loss(np.array([[truth[name] for name in setup.parameters.names]]))[0]
    noise = NOISE_DB * random.standard_normal(len(loss))
    results = {
        "belt": cb.calibrate(study(folder, links.assign(loss_db=loss + noise), belt)),
        "without": cb.calibrate(study(folder, links.assign(loss_db=loss + noise), belt, known=False)),
    }
    if bare:
        plain = links.assign(loss_db=unshaded + noise)
        results["no trees"] = cb.calibrate(study(folder, plain, belt, known=False))
    errors = {}
    for name, result in results.items():
        table = result.links[result.links["held_out"]]
        errors[name] = float(np.sqrt(np.mean((table["after_db"] - table["measured_db"]) ** 2)))
    low, high = np.quantile(results["belt"].uncertainty.draws[TREES], [0.05, 0.95])
    outline = shapely.box(*belt["boxes"][0])
    points, covers = points_at(results["without"], outline)
    return {
        "attenuation": attenuation,
        "effect_db": float(np.sqrt(np.mean((loss - unshaded) ** 2))),
        "shaded": int((loss - unshaded > 1.0).sum()),
        "covered": bool(low <= attenuation <= high),
        "width": high - low,
        "error": results["belt"].parameters[TREES] - attenuation,
        "identified": results["belt"].intervals[TREES].label == "identified",
        "belt_db": errors["belt"],
        "without_db": errors["without"],
        "points": points,
        "covers": covers,
        "alarm": points_at(results["no trees"], outline)[0] if bare else None,
        "seconds": time.process_time() - started,
    }


def on_lines(folder: Path, seed: int, number: int) -> dict[str, Any]:
    """Search for a planted belt in errors that follow from straight lines alone, without a trace or a calibration."""
    random, started = np.random.default_rng([seed, number, 291]), time.process_time()
    links = district(folder, seed)
    belt, attenuation = planted_belt(random)
    tx, rx = links[POSITION[:3]].to_numpy(), links[POSITION[3:]].to_numpy()
    outline = shapely.box(*belt["boxes"][0])
    length = Region(np.array([outline]), np.zeros(1), np.full(1, belt["top"])).length_inside(tx, rx)
    largest = RegionSection.model_validate_json(json.dumps(belt)).largest_loss_db(FREQUENCY)
    loss, noise = (
        largest * -np.expm1(-length * attenuation / largest),
        random.normal(0, NOISE_DB, len(length)),
    )
    found, without = missing_region(tx, rx, loss + noise), missing_region(tx, rx, noise)
    points = found is not None and found.significant
    covered = shapely.area(shapely.intersection(shapely.box(*found.box), outline)) if found else 0.0
    return {
        "shaded": int((loss > 1.0).sum()),
        "points": points,
        "covers": points and covered > shapely.area(outline) / 3,
        "alarm": without is not None and without.significant,
        "seconds": time.process_time() - started,
    }


def plain_study(folder: Path) -> None:
    """Print the time and path loss of a study without regions, compared with the bare evaluation of its paths."""
    links = district(folder, 900)
    engine = engines.make(Setup.open(study(folder, links, None)))
    assert isinstance(engine, engines.Replay)
    candidates = engine.parameters.from_unit(np.random.default_rng(0).random((320, len(engine.parameters))))
    program = fields.layout(engine.paths).program
    tables = engine.parameters.constants_of(candidates, engine.paths.materials)

    def bare() -> np.ndarray:
        combining = fields.Combining.make("power", engine.paths.link, engine.paths.delay)
        parts = [fields.path_losses(program, tables[k : k + 32], combining)[0] for k in range(0, 320, 32)]
        return np.concatenate(parts)

    seconds: dict[str, list[float]] = {"replay": [], "bare": []}
    for _ in range(21):
        for name, function in (("replay", lambda: engine.path_loss(candidates)), ("bare", bare)):
            started = time.process_time()
            function()
            seconds[name].append(time.process_time() - started)
    ratio = np.median(seconds["replay"][1:]) / np.median(seconds["bare"][1:])
    difference = np.abs(engine.path_loss(candidates) - bare())
    print(
        f"{engine.interactions} interactions, 320 candidates: replay takes {ratio:.3f} times the bare evaluation"
    )
    print(
        f"largest difference of path loss: {np.nanmax(np.where(np.isfinite(difference), difference, 0.0)):g} dB"
    )


def main() -> None:
    """Run the repetitions and print the table, or the check of a plain study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--districts", type=int, default=20)
    parser.add_argument("--first", type=int, default=300, help="seed of the first district")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=np.inf, help="start no repetition after this time")
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--lines", action="store_true")
    options = parser.parse_args()
    started, rows, links = time.perf_counter(), [], {}
    run = [
        (number, seed)
        for number in range(options.repetitions)
        for seed in range(options.first, options.first + options.districts)
    ]
    with tempfile.TemporaryDirectory() as root:
        if options.plain:
            plain_study(Path(root))
            return
        if options.lines:
            for number, seed in run:
                if time.perf_counter() - started < options.seconds:
                    rows.append(on_lines(Path(root) / str(seed), seed, number))
            table = pd.DataFrame(rows)
            print(table.mean().round(3).to_string())
            seen = table[table["shaded"] >= 8]
            print(
                f"{len(table)} belts; 8 links or more lose 1 dB or more behind {len(seen)} of them, of which"
            )
            print(
                f"{seen['points'].mean():.2f} are reported as a region and {seen['covers'].mean():.2f} at the belt"
            )
            return
        # Every district has its first repetition before any has its second, so that an interrupted run has all
        # districts.
        for number, seed in run:
            if time.perf_counter() - started < options.seconds:
                folder = Path(root) / str(seed)
                if seed not in links:
                    links[seed] = reached(folder, seed)
                row = repetition(folder, links[seed], [seed, number, 290], number == 0)
                rows.append({"seed": seed, **row})
                print(
                    *(f"{name}={value:.3g}" for name, value in rows[-1].items() if value is not None),
                    flush=True,
                )
    table = pd.DataFrame(rows)
    gain = table["without_db"] - table["belt_db"]
    print(table.select_dtypes("number").median().round(2).to_string())
    print(f"{len(table)} repetitions")
    print(f"attenuation in its 90 % interval: {table['covered'].mean():.3f}")
    print(f"identified: {table['identified'].mean():.2f}")
    print(
        f"validation prefers the model with the belt: {(gain > 0).mean():.2f}, median gain {gain.median():.2f} dB"
    )
    print(
        f"the page points at a region: {table['points'].mean():.2f}, at the belt {table['covers'].mean():.2f}"
    )
    alarms = table["alarm"].dropna()
    print(f"without trees it points at a region: {alarms.mean():.2f} of {len(alarms)}")


if __name__ == "__main__":
    main()
