"""Attacks on `calibray map`: its numbers, and where it writes."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from random import Random

import numpy as np
import pandas as pd

from fuzzing import world
from fuzzing.mutations import TEXTS
from fuzzing.outcome import Case
from fuzzing.outside import TARGETS
from fuzzing.world import OWN, World

SENSIBLE: dict[str, tuple[tuple[str, ...], ...]] = {
    "--tx": (("0", "0", "2"), ("-5", "3", "30"), ("10", "0", "1e-3"), ("1e4", "0", "2")),
    "--height": (("1.5",), ("0.01",), ("40",)),
    "--cell": (("20",), ("33.3",), ("500",)),
    "--bounds": (("-40", "-40", "40", "40"), ("0", "0", "25", "30"), ("500", "500", "600", "600")),
    "--level": (("0",), ("0.5",), ("0.999",)),
    "--power": (("0",), ("-30",), ("43.5",)),
    "--samples": (("1000",), ("1",), ("auto",)),
    "--column": (("half=a",), ("half=b",), ("half=zz",)),
}
SENSELESS: dict[str, tuple[tuple[str, ...], ...]] = {
    "--tx": (("nan", "0", "2"), ("0", "inf", "2"), ("0", "0"), ("x", "0", "2"), ("0", "0", "1e400")),
    "--height": (("nan",), ("-inf",), ("",), ("1,5",)),
    "--cell": (("0",), ("-5",), ("nan",), ("inf",), ("1e-320",)),
    "--bounds": (("40", "-40", "-40", "40"), ("nan", "0", "9", "9"), ("0", "0", "0", "0"), ("0", "0", "9", "inf")),
    "--level": (("1",), ("1.5",), ("-0.5",), ("nan",)),
    "--power": (("nan",), ("inf",), ("loud",)),
    "--samples": (("0",), ("-5",), ("nan",), ("many",), ("1.5",), ("9" * 400,)),
    "--column": (("half",), ("=a",), ("nothing=1",), ("half=nan",)),
}  # fmt: skip
LARGE: dict[str, tuple[tuple[str, ...], ...]] = {
    "--tx": (("1e300", "0", "2"), ("0", "0", "-1e9"), ("5e15", "5e15", "1")),
    "--height": (("1e300",), ("-5",), ("0",)),
    "--cell": (("1e-9",), ("0.001",), ("1e300",)),
    "--bounds": (("-1e9", "-1e9", "1e9", "1e9"), ("-1e300", "0", "1e300", "9"), ("0", "0", "1e-9", "1e-9")),
    "--level": (("1e-300",), ("0.9999999999999999",)),
    "--power": (("1e300",), ("-1e9",)),
    "--samples": (("1000000000000",), ("2000000",)),
}
"""What nothing forbids by its form: refused, announced, or done."""


def coverage(rng: Random, found: World, folder: Path) -> Case:
    """A map with options that mean something, nothing, or too much."""
    found.copy(folder, "out")
    (folder / "link").symlink_to("notes.txt")
    chosen = {"--cell": ("20",), "--tx": ("0", "0", "2"), "--column": ("half=a",)}
    bad = False
    for option in rng.sample(list(SENSIBLE), rng.randrange(4)):
        chosen[option] = rng.choice(SENSIBLE[option])
    attack = rng.choice((SENSIBLE, SENSELESS, SENSELESS, LARGE, LARGE))
    option = rng.choice(list(attack))
    chosen[option], bad = rng.choice(attack[option]), attack is SENSELESS
    words = ["map", "out", *(word for option, values in chosen.items() for word in (option, *values))]
    target = rng.choice(("new", "new", "new", *TARGETS))
    words += ["-o", target]
    if rng.random() < 0.1:
        words += [
            rng.choice(
                (
                    "--overwrite",
                    "--allow-changed-inputs",
                    "--",
                    "--no-such-option",
                    rng.choice(TEXTS[:30]).replace("\0", ""),
                )
            )
        ]

    def act() -> list[float]:
        here = Path.cwd()
        os.chdir(folder)
        try:
            world.calibray(*words)
            table = pd.read_csv(Path(target) / "map.csv")
        finally:
            os.chdir(here)
        # Where no path leads there is no power, and no interval; nearly certain ones have no end.
        told = table[table.columns[2:]].select_dtypes(np.number).fillna(np.inf)
        return told.replace(-np.inf, np.inf).to_numpy().ravel().tolist()

    own = (*OWN, "deep", "fresh", "paid", "new", "new/*", "map.*", "meshes/map.*")
    return Case("map", shlex.join(words)[:400], act, bad, own=own)
