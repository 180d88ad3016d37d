"""Check whether tracing and replay work on this machine, and suggest remedies if they do not.

Version numbers alone do not show whether a library works, so Dr.Jit, Sionna RT and JAX each run a small test. The tests
run in subprocesses, because a libLLVM that Dr.Jit cannot use kills the process.
"""

from __future__ import annotations

import platform
import re
import signal
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata

from calibray.errors import InputError
from calibray.tables import Column, Table
from calibray.tracing import llvm
from calibray.tracing.llvm import Llvm

CHECK_TIMEOUT = 300.0
"""Time limit of one check [s]; if the disk is slow, the first import alone can take most of this time."""

# Package name and, if present, extra: "numpy>=2.0", "pyarrow>=16; extra == 'parquet'".
_REQUIREMENT = re.compile(r"""^([\w.-]+)(?:.*extra == ['"]([\w-]+)['"])?""")

# Optional dependencies for developing Calibray itself; users do not need them.
_DEVELOPER_EXTRAS = frozenset({"test", "docs", "lint"})

# Sum of min(0, 2) to min(3, 2). An unusable LLVM cannot compile `minimum`, although it can compile `sum`.
_KERNEL = """
import importlib, sys
import drjit
Float = importlib.import_module("drjit." + sys.argv[1].split("_")[0]).Float
total = drjit.sum(drjit.minimum(drjit.arange(Float, 4), 2.0))[0]
if total != 5.0:
    sys.exit(f"the sum is {total}, not 5")
"""

# A closed box has the direct path and one reflection from each of its six faces.
_TRACE = """
import sys
import mitsuba
mitsuba.set_variant(sys.argv[1])
import sionna.rt as rt
scene = rt.load_scene(rt.scene.box)
scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.add(rt.Transmitter("tx", [0.0, 0.0, 2.0]))
scene.add(rt.Receiver("rx", [2.0, 1.0, 2.0]))
count = int(rt.PathSolver()(scene, max_depth=1, samples_per_src=10_000).valid.numpy().sum())
if count != 7:
    sys.exit(f"{count} paths in a closed box, not 7")
print("7 paths in a closed box")
"""

_JAX = """
import jax
jax.numpy.arange(4.0).sum().block_until_ready()
print(", ".join(f"{device.platform}:{device.id}" for device in jax.devices()))
"""


@dataclass(frozen=True)
class Check:
    """The outcome of checking one library that Calibray requires.

    Attributes:
        name: The library.
        passed: Whether the library works.
        detail: Result of the check, or the reason for the failure.
        remedy: Recommended action if the check failed.
    """

    name: str
    passed: bool
    detail: str
    remedy: str


@dataclass(frozen=True)
class Diagnosis:
    """The state of a machine, as `calibray doctor` prints it.

    Attributes:
        versions: Python, Calibray and each required package, each with its version or, for a missing package, the
            installation command.
        variant: The Mitsuba variant used for tracing.
        cuda_devices: Number of GPUs on which Mitsuba can trace.
        libraries: Every libLLVM found on this machine.
        checks: The results of the checks.
    """

    versions: tuple[tuple[str, str], ...]
    variant: str
    cuda_devices: int
    libraries: tuple[Llvm, ...]
    checks: tuple[Check, ...]

    @property
    def usable(self) -> bool:
        """Whether Calibray works on this machine."""
        return all(check.passed for check in self.checks)

    def table(self) -> Table:
        """Tabulate versions, libraries, checks with remedies, and the verdict, in two columns without headings."""
        rows = [
            *self.versions,
            ("Mitsuba variant", self.variant),
            ("GPUs for tracing", str(self.cuda_devices)),
            *(
                (f"libLLVM {library.label}", f"{library.path}, {library.problem or 'usable'}")
                for library in self.libraries
            ),
            *((check.name, f"{'ok' if check.passed else 'FAILED'}, {check.detail}") for check in self.checks),
            *(("To do", check.remedy) for check in self.checks if not check.passed),
            (
                "Verdict",
                "Calibray works on this machine"
                if self.usable
                else "Calibray cannot trace and replay on this machine",
            ),
        ]
        return Table("", (Column(), Column()), tuple(rows))


def examine() -> Diagnosis:
    """Check this machine, which takes a few seconds; no exception is raised if the machine is unusable."""
    variant = llvm.mitsuba_variant()
    return Diagnosis(
        versions=versions(),
        variant=variant,
        cuda_devices=llvm.cuda_device_count(),
        libraries=llvm.installed_libraries(),
        checks=(*check_tracing(variant), run_check("JAX", _JAX, (), "pip install --force-reinstall jax")),
    )


def check_tracing(variant: str) -> tuple[Check, ...]:
    """Check the libraries that a Mitsuba variant needs for tracing: Dr.Jit, Sionna RT and, on the CPU, libLLVM.

    The checks stop at the first failure, because the later checks depend on the earlier ones.
    """
    remedy = "update the NVIDIA driver, or set CUDA_VISIBLE_DEVICES= to trace on the CPU"
    checks = []
    if variant.startswith("llvm"):
        remedy = f"{llvm.install_command()}, or name another libLLVM in {llvm.PATH_VARIABLE}"
        try:
            library = llvm.select()
        except InputError as error:
            return (Check("LLVM", False, "none in use", str(error)),)
        trust = "" if library.tested else f" (versions known to work: {sorted(llvm.TESTED_MAJORS)})"
        checks.append(Check("LLVM", True, f"{library.label} at {library.path}{trust}", remedy))
    checks.append(run_check("Dr.Jit", _KERNEL, (variant,), remedy))
    if checks[-1].passed:
        checks.append(run_check("Sionna RT", _TRACE, (variant,), "pip install --force-reinstall sionna-rt"))
    return tuple(checks)


def run_check(name: str, code: str, arguments: tuple[str, ...], remedy: str) -> Check:
    """Run Python code in a subprocess to check a library.

    The code prints its findings, or fails with an exception, an exit status or a signal. The `detail` of the returned
    check contains the output of the code or, after a failure, the lines that state the cause.
    """
    command = [sys.executable, "-c", code, *arguments]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=CHECK_TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return Check(name, False, f"no answer within {CHECK_TIMEOUT:g} s", remedy)
    if run.returncode == 0:
        return Check(name, True, run.stdout.strip() or "works", remedy)
    lines = run.stderr.strip().splitlines() or [f"exit status {run.returncode} without a message"]
    if run.returncode < 0:
        # LLVM prints the reason for a crash first, and then a stack trace.
        return Check(name, False, f"killed by {signal.Signals(-run.returncode).name}: {lines[0]}", remedy)
    # In a chain of exceptions, the first exception is the cause. If there is no exception, the last line is the exit
    # message.
    reasons = [line for line in lines if re.match(r"[\w.]*(Error|Exception)\b", line)] or lines[-1:]
    return Check(name, False, "; ".join(reasons), remedy)


def versions() -> tuple[tuple[str, str], ...]:
    """Names and versions of Python, Calibray, and each package that Calibray's metadata lists as required.

    For a missing package, the command that installs the package is listed instead of a version.
    """
    packages = {"calibray": "pip install calibray"}
    # A copy of the source code has no metadata until it is installed.
    requirements = metadata.requires("calibray") if _version("calibray") else None
    for requirement in requirements or []:
        name, extra = _REQUIREMENT.findall(requirement)[0]
        if extra not in _DEVELOPER_EXTRAS:
            packages.setdefault(name, f"pip install 'calibray[{extra}]'" if extra else f"pip install {name}")
        # Sionna RT requires specific versions of these two packages and installs them.
        if name == "sionna-rt":
            packages |= {needed: "pip install --force-reinstall sionna-rt" for needed in ("mitsuba", "drjit")}
    installed = {name: _version(name) or f"not installed: {command}" for name, command in packages.items()}
    return ("python", platform.python_version()), *installed.items()


def _version(package: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
