"""Run thousands of cases of hostile input from a seed; list the outcomes of each kind of input, and forbidden ones.

Run with: python benchmarks/fuzz.py [--cases N] [--seed S] [--workers W] [--kinds NAME ...], or, to see one case again,
python benchmarks/fuzz.py --seed S --case N

Each worker process runs one case at a time. A case that hangs or crashes is counted, and its worker is replaced. As
root on Linux, the workers run in a separate mount namespace, in which everything except a temporary folder is
read-only.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

LIMIT = 30.0
"""Limit of a case's processor time [s]; its wall time may be four times as long, in case the machine is busy."""
START = 600.0
"""Time that a worker may take to start [s]."""
INSIDE = "CALIBRAY_FUZZ_PLACE"  # the temporary folder, set within the mount namespace
PROGRAMS = (
    "study",
    "answer",
    "ledger",
    "line",
    "paths",
    "cache",
    "table",
    "bomb",
    "occupied",
    "rays",
    "section",
)
"""Kinds that may start programs: that of the study, or Calibray itself to read a file within limits."""
COST = re.compile(r"\d (GiB|MiB|GB|rays|minutes|hours|days|seconds|RT calls|calls)\b")


def work(place: Path, seed: int, kinds: list[str]) -> None:
    """Run the cases whose numbers are on standard input, and print their outcomes."""
    from fuzzing.kinds import make
    from fuzzing.outcome import MEMORY, Case, Verdict, Watch, judge, peak, restart_peak
    from fuzzing.world import World

    faulthandler.enable()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of libraries must not mix with the answers
    found = World.open(place)
    found.warm()
    tempfile.tempdir = str(place)
    watch = Watch(str(place))
    sys.addaudithook(watch)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        number = int(line)
        folder = Path(tempfile.mkdtemp(dir=place, prefix=f"case-{number}-"))
        os.environ["CALIBRAY_CACHE"] = str(place / "cache")
        os.ftruncate(2, 0)
        restart_peak()
        try:
            case = make(seed, number, found, folder, kinds)
        except Exception:
            case = Case("broken", traceback.format_exc(), lambda: None, damaged=True)
        # The case is described first, because the process may end during it.
        print(json.dumps({"number": number, "kind": case.kind, "note": case.note}), file=answers, flush=True)
        started = time.monotonic()
        watch.programs = case.kind in PROGRAMS
        verdict = judge(case, folder, watch)
        if peak() > MEMORY:
            verdict = Verdict("memory", f"{peak() / 2**30:.1f} GiB; {verdict.verdict} {verdict.detail}")
        answer = asdict(verdict) | {"seconds": time.monotonic() - started}
        print(json.dumps(answer), file=answers, flush=True)
        _remove(folder)


def _remove(folder: Path) -> None:
    """Remove a case's folder."""
    for path in (folder, *folder.rglob("*")):
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o700)
    shutil.rmtree(folder, ignore_errors=True)


class Worker:
    """A process that runs cases, and is restarted if it is lost."""

    def __init__(self, place: Path, name: str, seed: int, kinds: list[str]) -> None:
        self._place, self._errors, self._seed, self._kinds = place, place / f"{name}.err", seed, kinds
        self._closed = False
        self._start()

    def _start(self) -> None:
        """Start the process; it is ended again if this process is asked to end meanwhile."""
        command = [sys.executable, __file__, "--work", str(self._place), "--seed", str(self._seed)]
        command += ["--kinds", *self._kinds] if self._kinds else []
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors.open("ab"), text=True,
            start_new_session=True,
        )  # fmt: skip
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, args=(self._process, self._lines), daemon=True).start()
        try:
            ready = self._next(START)
        except SystemExit:
            self.close()
            raise
        if ready != "ready\n":
            sys.exit(f"a worker does not start:\n{self._errors.read_text()[-3000:]}")

    @staticmethod
    def _listen(process: subprocess.Popen, lines: queue.Queue[str]) -> None:
        for line in process.stdout:
            lines.put(line)
        lines.put("")

    def _next(self, limit: float) -> str | None:
        try:
            return self._lines.get(timeout=limit)
        except queue.Empty:
            return None

    def _spent(self) -> float:
        """Processor time of the process [s]; 0 if the system does not report it."""
        try:
            words = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0
        return sum(map(int, words[11:13])) / os.sysconf("SC_CLK_TCK")

    def run(self, number: int) -> dict[str, object]:
        """Run a case, and return its outcome."""
        self._process.stdin.write(f"{number}\n")
        self._process.stdin.flush()
        answer: dict[str, object] = {"number": number, "kind": "unmade", "note": ""}
        for _ in range(2):  # its description, and its outcome
            line, before, started = None, self._spent(), time.monotonic()
            while line is None and max(self._spent() - before, (time.monotonic() - started) / 4) < LIMIT:
                line = self._next(1.0)
            if not line:
                return answer | self._lost(line == "")
            answer |= json.loads(line)
        return answer

    def _lost(self, ended: bool) -> dict[str, object]:
        """The outcome of a case whose process ended or hangs; a new process takes its place."""
        from fuzzing.outcome import MEMORY, peak

        said, large = self._errors.read_text(errors="replace")[-3000:], peak(self._process.pid) > MEMORY
        self.end()
        verdict = "crash" if ended else "memory" if large else "announced" if COST.search(said) else "hang"
        lost = {"verdict": verdict, "detail": f"status {self._process.returncode}, {said}", "seconds": LIMIT}
        if not self._closed:
            self._start()
        return lost

    def close(self) -> None:
        """End the process without starting a new one."""
        self._closed = True
        self.end()

    def end(self) -> None:
        """End the process and all processes that it started."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, 9)
        self._process.wait()


def attack(
    place: Path, numbers: list[int], seed: int, workers: int, kinds: list[str]
) -> list[dict[str, object]]:
    """Run cases, with progress on stderr."""
    waiting: queue.Queue[int] = queue.Queue()
    for number in numbers:
        waiting.put(number)
    found: list[dict[str, object]] = []

    def serve(worker: Worker) -> None:
        while True:
            try:
                number = waiting.get_nowait()
            except queue.Empty:
                worker.end()
                return
            answer = worker.run(number)
            found.append(answer)
            if answer["verdict"] in FORBIDDEN:
                print(
                    f"\ncase {number}: {answer['verdict']}: {answer['kind']}, {answer['note']}\n{answer['detail']}",
                    file=sys.stderr,
                )

    # The first worker makes the world that the others find.
    team = [Worker(place, "worker-0", seed, kinds)]

    def join(name: str) -> None:
        team.append(Worker(place, name, seed, kinds))
        serve(team[-1])

    threads = [threading.Thread(target=serve, args=(team[0],), daemon=True)] + [
        threading.Thread(target=join, args=(f"worker-{k}",), daemon=True)
        for k in range(1, min(workers, len(numbers)))
    ]
    started = time.monotonic()
    for thread in threads:
        thread.start()
    seen, written = sys.stderr.isatty(), started
    try:
        while any(thread.is_alive() for thread in threads):
            time.sleep(0.5)
            if seen or time.monotonic() - written > 30:
                written = time.monotonic()
                line = f"{len(found)} of {len(numbers)} cases, {written - started:.0f} s"
                print(line, end="\r" if seen else "\n", file=sys.stderr, flush=True)
    finally:
        for worker in team:
            worker.close()
    print(file=sys.stderr)
    if len(found) < len(numbers):
        sys.exit(f"only {len(found)} of {len(numbers)} cases were run: a worker could not be started")
    return found


def report(found: list[dict[str, object]]) -> int:
    """Print counts by kind and outcome; return 1 if an outcome is forbidden."""
    counts = Counter((str(answer["kind"]), str(answer["verdict"])) for answer in found)
    columns = [*ALLOWED, *FORBIDDEN]
    print(f"{'':9}{'cases':>7}{'ms':>7}" + "".join(f"{name:>11}" for name in columns))
    for kind in [*sorted({kind for kind, _ in counts}), "all"]:
        row = [sum(n for (k, v), n in counts.items() if kind in (k, "all") and v == name) for name in columns]
        spent = [float(str(answer["seconds"])) for answer in found if kind in (answer["kind"], "all")]
        print(
            f"{kind:9}{sum(row):7}{1e3 * sum(spent) / len(spent):7.0f}"
            + "".join(f"{number:11}" for number in row)
        )
    bad = sorted(int(str(answer["number"])) for answer in found if answer["verdict"] in FORBIDDEN)
    if bad:
        print(f"\nforbidden: {', '.join(map(str, bad[:100]))}; see one again with --case N")
    return 1 if bad else 0


def main(place: Path, chosen: argparse.Namespace) -> int:
    """Run the chosen cases."""
    numbers = (
        [chosen.case] if chosen.case is not None else list(range(chosen.first, chosen.first + chosen.cases))
    )
    found = attack(place, numbers, chosen.seed, chosen.workers, chosen.kinds)
    if chosen.case is not None:
        answer = found[0]
        print(f"{answer['kind']}: {answer['note']}\n{answer['verdict']}: {answer['detail']}")
    return report(found)


def _apart(place: str) -> int:
    """Restart where only the temporary folder, whose files are in memory, is writable."""
    script = (
        f"mount --make-rprivate / && mount -t tmpfs -o size=2g tmpfs {place} && mount -o remount,bind,ro / && "
        'mount -o remount,bind,ro /dev; mount -t tmpfs -o size=1g tmpfs /dev/shm; exec "$@"'
    )
    command = ["unshare", "-m", "sh", "-c", script, "sh", sys.executable, *sys.argv]
    process = subprocess.Popen(command, env={**os.environ, INSIDE: place})
    try:
        return process.wait()
    finally:
        # This signal also ends its workers.
        process.terminate()
        process.wait()


def _end(number: int, _: object) -> None:
    """End on a signal as on an error, so that child processes are ended as well."""
    sys.exit(128 + number)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", default=[], help="functions of fuzzing.kinds.SHARES, by name")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--case", type=int, help="run this case, and print its full outcome")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work is not None:
        work(options.work, options.seed, options.kinds)
        sys.exit()
    from fuzzing.outcome import ALLOWED, FORBIDDEN

    signal.signal(signal.SIGTERM, _end)
    if INSIDE not in os.environ:
        with tempfile.TemporaryDirectory(prefix="calibray-fuzz-") as fresh:
            alone = ["unshare", "-m", "true"]
            if (
                os.geteuid() == 0
                and subprocess.run(alone, check=False, stderr=subprocess.DEVNULL).returncode == 0
            ):
                sys.exit(_apart(fresh))
            os.environ[INSIDE] = fresh
            print("no mounts allowed here: cases run as this user does", file=sys.stderr)
            os.environ |= {"HOME": fresh, "TMPDIR": fresh, "XDG_STATE_HOME": f"{fresh}/state"}
            sys.exit(main(Path(fresh), options))
    here = os.environ[INSIDE]
    os.environ |= {
        "HOME": here,
        "TMPDIR": here,
        "XDG_STATE_HOME": f"{here}/state",
        "XDG_CACHE_HOME": f"{here}/.cache",
    }
    sys.exit(main(Path(here), options))
