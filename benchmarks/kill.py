"""Studies that are killed, interrupted, or deprived of their disk at random moments, and restarted each time.

Run with: python benchmarks/kill.py [--kills N] [--seed S] [--studies NAMES]

As root on Linux, the script uses its own mount namespace, for disks that are full or read-only; otherwise it only sends
signals.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))


import programs
import restarts
from restarts import Harm

INSIDE = "CALIBRAY_KILL_INSIDE"  # set within the mount namespace
SIGNALS, DISKS = ("kill", "terminate", "interrupt"), ("full", "read-only")
PAUSE = "import time; time.sleep(0.02)"
DISK = "size=8m"


@dataclass(frozen=True)
class Case:
    """One study that is disturbed.

    Attributes:
        method: Its method.
        options: The method's settings.
        workers: Number of programs that run at once.
        engine: Its engine.
    """

    method: str
    options: str
    workers: int = 0
    engine: str = "command"


STUDIES = {
    "sgwo-im": Case("sgwo-im", "{ population = 10, iterations = 14, full_iterations = 5, elites = 3 }"),
    "sgwo-im-4": Case("sgwo-im", "{ population = 10, iterations = 14, full_iterations = 5, elites = 3 }", 4),
    "random-4": Case("random", "{ budget = 120 }", 4),
    "auto-3": Case("auto", "{ budget = 36, batch = 3 }", 3),
    "retrace": Case("gwo", "{ population = 6, iterations = 6 }", engine="retrace"),
    "replay": Case("gwo", "{ population = 20, iterations = 20 }", engine="replay"),
}


def prepare(folder: Path, case: Case, mounts: bool) -> None:
    """A study in a separate folder, with its output on a separate small disk."""
    (folder / "out").mkdir(parents=True)
    if mounts:
        subprocess.run(["mount", "-t", "tmpfs", "-o", DISK, "tmpfs", str(folder / "out")], check=True)
    programs.study_file(folder, PAUSE, case.method, case.options)
    file = folder / "study.toml"
    text = file.read_text().replace('name = "command"', f'name = "{case.engine}"')
    shallow = "trace = { max_depth = 1, samples = 10_000 }"
    file.write_text(
        text.replace(shallow, "trace = { max_depth = 2, samples = 20_000, line_of_sight = false }")
    )


def plan(case: Case, kills: int, calls: int, seconds: float, kinds: tuple[str, ...], seed: int) -> list[Harm]:
    """Disturbances of random kinds at random moments."""
    rng = random.Random(seed)
    if case.engine == "replay":  # without a ledger, the disk matters only at the end
        return [Harm(rng.choice(SIGNALS), seconds=rng.uniform(0, 0.9 * seconds)) for _ in range(kills)]
    last = max(2, calls - max(case.workers, 1))
    moments = sorted(rng.randrange(1, last) for _ in range(kills))
    return [Harm(rng.choice(kinds), calls=moment) for moment in moments]


def disturb(runner: subprocess.Popen, place: Path, name: str, kills: int, seed: int, mounts: bool) -> bool:
    """Run a study undisturbed and disturbed, print the outcome, and return whether it is as required."""
    case, folders = STUDIES[name], [place / f"{name}-undisturbed", place / f"{name}-disturbed"]
    for folder in folders:
        prepare(folder, case, mounts)
    started = time.perf_counter()
    undisturbed = restarts.finish(runner, folders[0], [], workers=case.workers)
    seconds = time.perf_counter() - started
    kinds = SIGNALS + DISKS if mounts else SIGNALS
    harms = plan(case, kills, len(undisturbed.asked), seconds, kinds, seed)
    started = time.perf_counter()
    found = restarts.finish(runner, folders[1], harms, seed, case.workers)
    each = (time.perf_counter() - started) / (len(harms) + 1)
    same = found.result == undisturbed.result and set(found.committed) == set(undisturbed.committed)
    again = len(found.asked) - len(set(found.asked))
    counts = Counter(harm.kind for harm in harms)
    print(
        f"{name:11}{found.kills:6}  {' '.join(f'{counts[kind]:>9}' for kind in SIGNALS + DISKS)}{len(found.asked):7}"
        f"{len(found.committed):11}{again:13}{found.repeated:10}{found.lost:6}  {'yes' if same else 'NO ':4}"
        f"{each:9.2f}",
        flush=True,
    )
    return same and not found.repeated and not found.lost


def together(runners: tuple[subprocess.Popen, ...], place: Path, name: str, seed: int) -> bool:
    """Start a study twice on one ledger; in a second round, also kill one of the two and restart it."""
    case, rng, folder = STUDIES[name], random.Random(seed), place / f"{name}-together"
    prepare(folder, case, False)
    well = True
    for kill in (False, True):
        (folder / "calls.log").unlink(missing_ok=True)
        for file in (folder / "out").iterdir():
            file.unlink()
        first = restarts.Run(runners[0], folder, case.workers, Harm("kill", rng.randrange(5, 25)))
        time.sleep(rng.uniform(0, 0.5))
        second = restarts.Run(runners[1], folder, case.workers)
        if kill:
            first.harm(rng.uniform(0, 0.04))
            first.end()
            first = restarts.Run(runners[0], folder, case.workers)
        ends = first.end(), second.end()
        asked = programs.calls(folder)
        twice = len(asked) - len(set(asked))
        well &= ends == (0, 0) and twice <= kill * max(case.workers, 1)
        print(
            f"{name:11}{'one of two killed' if kill else 'two undisturbed':20}{len(asked):7} calls, "
            f"{twice} made twice, exit {ends[0]} and {ends[1]}",
            flush=True,
        )
    return well


def release(place: Path) -> None:
    """Unmount the disks of the studies in a folder."""
    for folder in place.glob("*/out"):
        if folder.is_mount():
            subprocess.run(["umount", str(folder)], check=False, stderr=subprocess.DEVNULL)


def main() -> int:
    """Disturb every study, and run two at once; return 0 if nothing was lost, repeated or changed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=30, help="total number of kills over the studies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--studies", default=",".join(STUDIES), help="names, separated by commas")
    chosen = parser.parse_args()
    names, mounts = chosen.studies.split(","), INSIDE in os.environ
    with tempfile.TemporaryDirectory() as place, restarts.open_runner() as one, restarts.open_runner() as two:
        print(
            f"study     harmed  {' '.join(f'{kind:>9}' for kind in SIGNALS + DISKS)}  calls  committed  under way"
            "  repeated  lost  same  s a run"
        )
        share = [chosen.kills // len(names) + (k < chosen.kills % len(names)) for k in range(len(names))]
        try:
            well = [
                disturb(one, Path(place), name, kills, chosen.seed + k, mounts)
                for k, (name, kills) in enumerate(zip(names, share, strict=True))
            ]
            well += [
                together((one, two), Path(place), name, chosen.seed)
                for name in names
                if STUDIES[name].engine != "replay"
            ]
        finally:
            release(Path(place))
    print("all well" if all(well) else "NOT WELL")
    return 0 if all(well) else 1


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as state:
        os.environ |= {"XDG_STATE_HOME": state, "CALIBRAY_CACHE": f"{state}/cache"}
        if INSIDE not in os.environ:
            alone = subprocess.run(["unshare", "-m", "true"], check=False, stderr=subprocess.DEVNULL)
            if alone.returncode == 0:
                os.environ[INSIDE] = "1"
                command = ["unshare", "-m", sys.executable, *sys.argv]
                sys.exit(subprocess.run(command, check=False).returncode)
            print("no mounts allowed here: disks are left alone")
        sys.exit(main())
