"""Ray mapping on foreign engines: calls until the RMSE is within 0.01 dB of the engine's own optimum.

    python benchmarks/ray_mapping.py --first 3000 --districts 20 --offices 10 --seeds 3 --out rays.jsonl
    python benchmarks/ray_mapping.py --first 3000 --districts 20 --offices 10 --seeds 3 --in-turn 1   # of eight engines
    python benchmarks/ray_mapping.py --first 3000 --districts 20 --in-turn 1 --engines "$OUTSIDE"   # see below

The engine is the replay of a district or an office with its own antennas, constants and physics, which the study does
not state; it returns the power of every path. Truths are drawn uniformly within the bounds, and the noise is 3 dB. The
excess of a call is the RMSE of its candidate on the engine minus that of the engine's optimum. The result is the number
of the first call whose excess is at most 0.01 dB.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Final

import jax
import numpy as np
import pandas as pd
import scipy.optimize

import districts
from calibray.engines import Replay
from calibray.engines.rays.compile import RaySetting, compile_rays, powers, rays_of
from calibray.engines.rays.export import Export
from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.fitting.ray_mapping import map_rays
from calibray.fitting.ray_model import HALF_SPACE
from calibray.fitting.search import least_squares
from calibray.materials import Material, itu_material
from calibray.paths import Kind, Paths, concatenate, take
from calibray.study import Setup, Study
from calibray.tracing.settings import Antenna
from finished_runs import append_run, read_runs
from problem_families.sites import office_site

NOISE_DB: Final = 3.0
REACHED_DB: Final = 0.01
FAILED: Final = 99  # calls of a repetition that does not reach the optimum, or fails
SEARCHES: Final = 128  # local searches for an engine's optimum
DIFFUSE: Final = 3  # diffuse paths per link
LEAST_POWER: Final = 1e-25  # of a path at the start values; the engines have no weaker paths

SAME: Final = (Antenna("dipole", "V"), Antenna("dipole", "V"))
OTHER: Final = (Antenna("tr38901", "V", (0.7, 0.1, 0.0)), Antenna("iso", "V"))
TURNED: Final = (Antenna("tr38901", "H", (0.7, 0.1, 0.0)), Antenna("hw_dipole", "H"))


def changed(material: Material, **factors: float) -> Material:
    """A material with constants multiplied by factors."""
    return replace(material, **{name: getattr(material, name) * factor for name, factor in factors.items()})


ENGINES: Final[dict[str, tuple[Any, Any]]] = {
    "same physics": (OTHER, lambda m, _: m),
    "half-spaces": (OTHER, lambda m, _: replace(m, thickness=HALF_SPACE)),
    "thicker": (OTHER, lambda m, _: changed(m, thickness=1.6, conductivity=3.0)),
    "polarization": (TURNED, lambda m, _: changed(m, thickness=1.6, conductivity=3.0)),
    "scattering": (SAME, lambda m, _: replace(changed(m, thickness=0.8), scattering_coefficient=0.4)),
    "conductivity": (OTHER, lambda m, _: changed(m, conductivity=10.0)),
    "thinner": (
        OTHER,
        lambda m, _: changed(m, thickness=0.5, conductivity=1 / 3, relative_permittivity=1.2),
    ),
    "ITU law": (
        OTHER,
        lambda m, f: replace(
            m, conductivity=itu_material("concrete", max(f, 1e9)).conductivity, thickness=0.25
        ),
        # The law is valid from 1 GHz.
    ),
}
"""Antennas, and a function of a material of the study and the carrier [Hz]; the candidate sets calibrated constants."""


def _tied(materials: dict[str, Material], start: dict[str, Material]) -> dict[str, Material]:
    """Materials that keep the loss tangent of the start values, so that conductivity changes with permittivity."""
    return {
        key: changed(item, conductivity=item.relative_permittivity / start[key].relative_permittivity)
        for key, item in materials.items()
    }


def _compressed(materials: dict[str, Material], _: dict[str, Material]) -> dict[str, Material]:
    """Materials whose susceptibilities are 0.7 times those of the candidate."""
    return {
        key: replace(item, relative_permittivity=1 + 0.7 * (item.relative_permittivity - 1))
        for key, item in materials.items()
    }


MATERIALS: Final = {"loss tangent": _tied, "permittivity law": _compressed}
"""Function that returns the materials of a call, from those of the candidate and of the start values."""

OUTSIDE: Final = (*MATERIALS, "first order", "strongest paths", "rounded powers")
"""Engines whose powers the model of rays cannot represent, with other antennas.

With "first order", permittivity affects only paths with one interaction. "Strongest paths" returns the five strongest
paths of each link. "Rounded powers" returns multiples of 0.1 dB.
"""

STRONGEST: Final = 5
LOCAL_SEARCHES: Final = 16  # for the optimum of an engine without derivatives


@dataclass(frozen=True)
class Place:
    """Links whose paths are traced.

    Attributes:
        name: Name of the place.
        setup: The study, which states no antennas.
        paths: Paths of the place between short dipoles.
    """

    name: str
    setup: Setup
    paths: Paths

    @classmethod
    def of(cls, name: str, study: Study) -> Place:
        """Trace a study that states short dipoles."""
        setup = study.opened()
        paths = _without_weak(setup.trace())
        content = {key: value for key, value in setup.study.content().items() if key != "antennas"}
        return cls(name, Study.from_content(content, study.path).opened(), paths)


def district(seed: int, folder: Path) -> Place:
    """A district of `districts.py`."""
    made = districts.make(f"district-{seed}", folder)
    return Place.of(made.name, made.problem.setup.study)


def office(seed: int, folder: Path) -> Place:
    """An office of `problem_families`, with 2 to 5 permittivities to calibrate."""
    random = np.random.default_rng([seed, 78])
    count = round(float(np.exp(random.uniform(np.log(20), np.log(100)))))
    site = office_site(random, 2 * count)
    frequency = float(random.choice([0.9e9, 2.1e9, 3.5e9, 6e9]))
    names = random.permutation(list(site.materials))[: random.integers(2, 6)].tolist()
    folder = folder / f"office-{seed}"
    table = pd.DataFrame(
        np.hstack([site.tx, site.rx]).round(3), columns=["tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z"]
    ).assign(loss_db=100.0)
    content = {
        "version": 1,
        "scene": {"file": str(site.write(folder / "scene")), "frequency": frequency},
        "links": {
            "file": "links.csv", "tx": ["tx_x", "tx_y", "tx_z"], "rx": ["rx_x", "rx_y", "rx_z"], "value": "loss_db"
        },
        "materials": {
            name: {
                "relative_permittivity": float(random.uniform(*ranges.relative_permittivity)),
                "conductivity": float(np.exp(random.uniform(*np.log(ranges.conductivity)))) * frequency / 4e9,
                "thickness": float(random.uniform(*ranges.thickness)),
            }
            for name, ranges in site.materials.items()
        },
        "antennas": {end: {"pattern": "dipole", "polarization": "V"} for end in ("tx", "rx")},
        "trace": {"max_depth": 3, "refraction": True, "samples": 100_000},
        "parameters": {f"{name}.relative_permittivity": {"bounds": [1.5, 12.0]} for name in names},
    }  # fmt: skip
    table.to_csv(folder / "links.csv", index=False)
    study = Study.from_content(content, folder / "study.toml")
    reached = np.setdiff1d(np.arange(len(table)), study.opened().trace().links_without_path)[:count]
    table.iloc[reached].to_csv(folder / "links.csv", index=False)
    return Place.of(f"office-{seed}", Study.from_content(content, folder / "study.toml"))


def _without_weak(paths: Paths) -> Paths:
    """The paths with at least a thousandth of their link's power."""
    power = powers(paths)
    return take(paths, np.flatnonzero(power > 1e-3 * np.bincount(paths.link, power)[paths.link]))


def with_diffuse(place: Place) -> Place:
    """The place with the strongest diffuse paths of every link, and a study with diffuse reflection."""
    content = place.setup.study.content()
    materials = {name: {"scattering_coefficient": 0.2} for name in place.paths.materials}
    stated = content.get("materials", {})
    materials = {name: {**stated.get(name, {}), **changed} for name, changed in materials.items()}
    dipole = {"pattern": "dipole", "polarization": "V"}
    rough = content | {
        "materials": materials,
        "antennas": {"tx": dipole, "rx": dipole},
        "trace": content.get("trace", {}) | {"max_depth": 1, "diffuse_reflection": True, "samples": 3_000},
    }
    file = place.setup.study.path
    mixed = Study.from_content(rough, file).opened().trace()
    path = np.repeat(np.arange(mixed.num_paths), np.diff(mixed.first))
    diffuse = np.unique(path[mixed.kind == Kind.DIFFUSE])
    power = powers(mixed)[diffuse]
    order = diffuse[np.lexsort((-power, mixed.link[diffuse]))]
    rank = np.arange(len(order)) - np.searchsorted(mixed.link[order], mixed.link[order])
    both = concatenate(
        [replace(place.paths, materials=mixed.materials), take(mixed, np.sort(order[rank < DIFFUSE]))]
    )
    setup = Study.from_content(content | {"materials": materials}, file).opened()
    return replace(place, setup=setup, paths=both)


class Foreign:
    """An engine that returns rays."""

    def __init__(self, place: Place, name: str) -> None:
        antennas, materials = ENGINES.get(name, (OTHER, lambda m, _: m))
        self.name = name
        setup, bare = place.setup, place.paths
        self.table = rays_of(place.paths)
        self.setting = RaySetting.of(setup)
        if antennas is not SAME:
            setting = RaySetting(setup.scene, setup.radio.frequency, antennas, setup.links)
            bare = compile_rays(replace(self.table, power=None), setting)
        bare = replace(
            bare, materials={key: materials(m, bare.frequency) for key, m in setup.scene.materials.items()}
        )
        traced = np.flatnonzero(powers(bare) > LEAST_POWER)
        self.paths, self.table = take(bare, traced), self.table.take(traced)
        self.parameters = setup.parameters
        self.replay = Replay(self.paths, self.parameters)

    def rays(self, candidate: np.ndarray) -> Export:
        """The answer to one candidate."""
        power = self.powers(candidate)
        answered = np.flatnonzero(power > 0)
        return Export.of_table(replace(self.table, power=power).take(answered), self.setting)

    def powers(self, candidate: np.ndarray) -> np.ndarray:
        """Power of every path for a candidate, 0 if the engine omits the path."""
        start = self.parameters.materials(self.parameters.start, self.paths.materials)
        materials = self.parameters.materials(candidate, self.paths.materials)
        if self.name in MATERIALS:
            materials = MATERIALS[self.name](materials, start)
        power = powers(replace(self.paths, materials=materials))
        if self.name == "first order":
            longer = np.diff(self.paths.first) > 1
            power[longer] = powers(replace(self.paths, materials=start))[longer]
        if self.name == "strongest paths":
            order = np.lexsort((-power, self.paths.link))
            rank = np.arange(len(order)) - np.searchsorted(self.paths.link[order], self.paths.link[order])
            power[order[rank >= STRONGEST]] = 0.0
        if self.name == "rounded powers":
            power = 10 ** ((10 * np.log10(power)).round(1) / 10)
        return power

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        """Path loss of the links [n, L] for candidates [n, d]."""
        with np.errstate(divide="ignore"):
            return np.stack(
                [
                    -10 * np.log10(np.bincount(self.paths.link, self.powers(each), self.paths.num_links))
                    for each in candidates
                ]
            )


def planted(place: Place, foreign: Foreign, random: np.random.Generator) -> tuple[Problem, np.ndarray]:
    """The problem on an engine's replay, with links measured with noise at a drawn truth [d], and this truth."""
    parameters = foreign.parameters
    truth = parameters.from_search(random.uniform(*parameters.search_bounds))
    loss = foreign.path_loss(truth[None])[0]
    measured = np.where(np.isfinite(loss), loss, 0.0) + NOISE_DB * random.standard_normal(len(loss))
    known = Problem.of(place.setup, foreign.replay)
    return replace(known, objective=replace(known.objective, measured=measured)), truth


def lowest(problem: Problem, foreign: Foreign, points: np.ndarray, random: np.random.Generator) -> float:
    """The lowest RMSE of an engine [dB], searched from points [n, d] and at random."""
    if foreign.name in ENGINES:
        return least_squares(problem, SEARCHES, points).best.y
    parameters, bounds = foreign.parameters, foreign.parameters.search_bounds
    span = bounds[1] - bounds[0]

    def residuals(unit: np.ndarray) -> np.ndarray:
        candidate = parameters.from_search(bounds[0] + unit * span)
        return problem.objective.residuals(foreign.path_loss(candidate[None]))[0]

    starts = [*(points - bounds[0]) / span, *random.uniform(size=(LOCAL_SEARCHES, len(span)))]
    # Rounded powers are constant over small steps.
    found = [
        scipy.optimize.least_squares(
            residuals, start, bounds=(-1e-9, 1 + 1e-9), diff_step=3e-2, max_nfev=30
        ).x
        for start in np.clip(starts, 0, 1)
    ]
    found += [
        scipy.optimize.minimize(
            lambda unit: float(np.mean(residuals(np.clip(unit, 0, 1)) ** 2)), best, method="Nelder-Mead",
            options={"maxfev": 300, "xatol": 1e-4, "fatol": 1e-6},
        ).x
        for best in sorted(found, key=lambda unit: float(np.sum(residuals(unit) ** 2)))[:2]
    ]  # fmt: skip
    candidates = parameters.from_search(bounds[0] + np.clip([*starts, *found], 0, 1) * span)
    return float(problem.objective.rmse(foreign.path_loss(candidates)).min())


def repetition(place: Place, foreign: Foreign, name: str, seed: int, most_calls: int) -> dict[str, Any]:
    """One planted truth on one engine."""
    started, parameters = time.process_time(), foreign.parameters
    random = np.random.default_rng([seed, 30])
    problem, truth = planted(place, foreign, random)
    mapped = map_rays(problem, foreign.rays, seed=seed, most_calls=most_calls)
    seconds = time.process_time() - started
    candidates = np.array([call.candidate for call in mapped.calls])
    optimum = lowest(problem, foreign, parameters.to_search(np.vstack([truth, candidates])), random)
    excess = problem.objective.rmse(foreign.path_loss(candidates)) - optimum
    return {
        "place": place.name, "engine": name, "seed": seed, "paths": foreign.paths.num_paths,
        "calls": next((k + 1 for k, value in enumerate(excess.tolist()) if value <= REACHED_DB), FAILED),
        "made": len(excess), "excess_db": excess.round(6).tolist(), "misfit_db": mapped.understanding.misfit_db,
        "gap_db": mapped.gap_db, "distant_gap_db": mapped.distant_gap_db, "changed_db": mapped.changed_db,
        "remaining_db": mapped.remaining_db, "moved_db": mapped.moved_db,
        "reached": mapped.reached, "understood": mapped.understood, "seconds": seconds,
    }  # fmt: skip


def _attempt(place: Place, name: str, seed: int, most_calls: int) -> dict[str, Any] | None:
    """Run a repetition; a failed one counts as not solved and states the error. None if the engine has no path."""
    started = time.process_time()
    try:
        foreign = Foreign(place, name)
        if foreign.paths.num_paths:
            return repetition(place, foreign, name, seed, most_calls)
        print(f"{place.name}, {name} left out: no path", flush=True)
        return None
    except Exception as error:
        return {
            "place": place.name, "engine": name, "seed": seed, "calls": FAILED, "made": 0, "excess_db": [],
            "reached": False, "understood": False, "seconds": time.process_time() - started,
            "error": f"{type(error).__name__}: {error}",
        }  # fmt: skip


def main() -> None:
    """Run the repetitions that are missing in the file, and print the quantiles of all repetitions."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--districts", type=int, default=2)
    parser.add_argument("--offices", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--engines", default=",".join(ENGINES))
    parser.add_argument(
        "--in-turn",
        type=int,
        default=len(ENGINES),
        help="number of engines per truth, taken in turn from the list",
    )
    parser.add_argument("--most-calls", type=int, default=6)
    parser.add_argument("--out", type=Path, help="file of the repetitions; an interrupted run continues")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no repetition after this time")
    options = parser.parse_args()
    engines, rows = options.engines.split(","), read_runs(options.out, {})
    ends = time.monotonic() + 60 * options.minutes
    done = {(row["place"], row["engine"], row["seed"]) for row in rows}
    order = [
        (make, options.first + number)
        for make, count in ((district, options.districts), (office, options.offices))
        for number in range(count)
    ]
    order = [order[index] for index in np.random.default_rng(30).permutation(len(order))]
    with tempfile.TemporaryDirectory() as folder:
        made = Places(Path(folder))
        # One visit is one truth per engine. An interrupted run has completed whole visits, in random order of the
        # places, and the engines of a visit share the functions compiled for the place.
        for visit, (seed, (make, number)) in enumerate(product(range(options.seeds), order)):
            jax.clear_caches()  # functions compiled for the previous place
            turns = range(
                options.in_turn * visit, options.in_turn * visit + min(options.in_turn, len(engines))
            )
            for name in [engines[turn % len(engines)] for turn in turns]:
                if time.monotonic() > ends or (f"{make.__name__}-{number}", name, seed) in done:
                    continue
                if (place := made.get(make, number, name == "scattering")) is None:
                    continue
                if (row := _attempt(place, name, seed, options.most_calls)) is None:
                    continue
                rows.append(row)
                print(json.dumps(row), flush=True)
                append_run(options.out, row)
    _report(rows)


def _report(rows: list[dict[str, Any]]) -> None:
    """Print the figures for all rows, for every kind of place, and for every engine."""
    groups = {"all": rows}
    for row in rows:
        groups.setdefault(row["place"].split("-")[0], []).append(row)
    for row in rows:
        groups.setdefault(row["engine"], []).append(row)
    for name, chosen in groups.items():
        if chosen:
            print(f"{name:14} {_summary(chosen)}")


@dataclass(frozen=True)
class Places:
    """Districts and offices, each made once.

    Attributes:
        folder: Folder of their files.
        made: Places made so far; None for a place that is left out.
    """

    folder: Path
    made: dict[tuple[str, int, bool], Place | None] = field(default_factory=dict)

    def get(self, make: Callable[[int, Path], Place], number: int, rough: bool) -> Place | None:
        """A place, with diffuse paths if `rough`."""
        key = make.__name__, number, rough
        if key not in self.made:
            try:
                place = self.get(make, number, False) if rough else make(number, self.folder)
                self.made[key] = with_diffuse(place) if rough and place is not None else place
            except InputError as error:  # some places draw a carrier for which P.2040 has no constants
                print(f"{make.__name__} {number} left out: {error}", flush=True)
                self.made[key] = None
        return self.made[key]


def _summary(rows: list[dict[str, Any]]) -> str:
    calls = np.array([row["calls"] for row in rows])
    understood, reached = (np.array([row[key] for row in rows]) for key in ("understood", "reached"))
    # The result is the best call.
    excess = np.array([min(row["excess_db"], default=np.inf) for row in rows])
    right = (excess > 0.02)[~reached]
    return (
        f"{len(rows)} runs: calls median {np.median(calls):g}, 90th percentile {np.quantile(calls, 0.9):g}; "
        f"{understood.sum()} understood, {reached.sum()} reached, {(excess[reached] > 0.05).sum()} of them above "
        f"0.05 dB (largest {excess[reached].max(initial=0.0):.4f} dB); {len(right)} perhaps missed, {right.sum()} of "
        f"them above 0.02 dB; {np.mean([row['seconds'] for row in rows]):.1f} s of CPU each; "
        f"{sum('error' in row for row in rows)} ended with an error"
    )


if __name__ == "__main__":
    main()
