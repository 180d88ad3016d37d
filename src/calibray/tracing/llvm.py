"""The runtime below the ray tracer: which libLLVM, or which GPU, Dr.Jit will run on.

On a machine without CUDA, Dr.Jit compiles its kernels with the newest libLLVM that it finds, and a version
that it cannot work with ends the whole process. So the choice is made here, before Dr.Jit is imported: every
candidate is opened in a process of its own, and `DRJIT_LIBLLVM_PATH` is set to the best one.

`python -m calibray.tracing.llvm` prints what the ray tracer will run on, or says what to install and exits with 2.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from calibray.errors import InputError

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""The environment variable that tells Dr.Jit its libLLVM."""

OLDEST_MAJOR = 17
"""Oldest accepted major version.

Dr.Jit 1.5 refuses 14 and older, and aborts on x86 with 15 and 16 ("Cannot select: fminimum"): LLVM compiles
`llvm.minimum` for x86 since 17 (reviews.llvm.org D145634 and D148691).
"""

TRIED_MAJORS = frozenset({19, 22})
"""Major versions on which Sionna RT 2.2 was seen to work; others are accepted with a note."""

PROBE_TIMEOUT = 30.0
"""Longest time [s] that opening one library may take."""

_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64/llvm*/lib*",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
    "/home/linuxbrew/.linuxbrew/opt/llvm*/lib",
)

# libLLVM-15.so.1, libLLVM-14.0.6.so.1, libLLVM.so.19.1, libLLVM.dylib, but neither libLLVM-C.dylib nor
# libLLVMSupport.so, which are parts of LLVM.
_NAME = re.compile(r"libLLVM(?:-(\d+)[\d.]*)?\.(?:so(?:\.(\d+)[\d.]*)?|dylib)")

# LLVMGetVersion came with LLVM 16; for a library without it nothing is printed.
_VERSION_PROBE = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
if hasattr(library, "LLVMGetVersion"):
    numbers = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*map(ctypes.byref, numbers))
    print(*(number.value for number in numbers))
"""

# Mitsuba traces rays on a GPU with OptiX, so a CUDA driver without it is of no use.
_CUDA_PROBE = """
import ctypes, os
driver = ctypes.CDLL(os.environ.get("DRJIT_LIBCUDA_PATH") or "libcuda.so.1")
ctypes.CDLL(os.environ.get("DRJIT_LIBOPTIX_PATH") or "libnvoptix.so.1")
count = ctypes.c_int()
if driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0:
    print(count.value)
"""


@dataclass(frozen=True)
class Llvm:
    """One libLLVM on this machine.

    Attributes:
        path: The file, or a bare name that the dynamic loader resolves.
        version: Major, minor and patch number, or the major alone, or nothing, as far as it is known.
        problem: Why Dr.Jit cannot use it; None if it can.
    """

    path: str
    version: tuple[int, ...]
    problem: str | None

    @property
    def usable(self) -> bool:
        """Whether Dr.Jit can compile with it."""
        return self.problem is None

    @property
    def tried(self) -> bool:
        """Whether this major version was seen to work, and is not just taken to."""
        return self.usable and self.version[0] in TRIED_MAJORS

    @property
    def label(self) -> str:
        """The version as text: `19.1.7`, or `unknown`."""
        return ".".join(map(str, self.version)) or "unknown"


def version_in_name(path: str) -> tuple[int, ...]:
    """Read the major version from a file name.

    Args:
        path: Path or name of a library.

    Returns:
        The major version alone, or nothing where the name holds none.

    Examples:
        >>> version_in_name("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1")
        (14,)
        >>> version_in_name("libLLVM.so.19.1")
        (19,)
        >>> version_in_name("libLLVM.dylib")
        ()
    """
    match = _NAME.fullmatch(Path(path).name)
    major = match and (match[1] or match[2])
    return (int(major),) if major else ()


def judge(path: str, reported: tuple[int, ...]) -> Llvm:
    """Decide whether a library that opens is one that Dr.Jit can use.

    Args:
        path: Path or name of the library.
        reported: The version that the library itself gives through `LLVMGetVersion`; empty if it gives none.

    Returns:
        The library with its version and, where it is not usable, the reason.
    """
    version = reported or version_in_name(path)
    if not reported and (not version or version[0] >= 16):
        return Llvm(path, (), "it reports no LLVM version, as every libLLVM since 16 does")
    if version[0] < OLDEST_MAJOR:
        return Llvm(path, version, f"LLVM {version[0]} is too old, Dr.Jit needs {OLDEST_MAJOR} or newer")
    return Llvm(path, version, None)


def inspect(path: str) -> Llvm:
    """Open a library in a process of its own, which a broken one may kill, and asks for its version.

    Args:
        path: Path of the library, or a bare name for the dynamic loader.

    Returns:
        What was found; a library that is missing, broken or too old comes with its `problem`.
    """
    output, problem = _probe(_VERSION_PROBE, path)
    if problem is not None:
        return Llvm(path, version_in_name(path), f"it cannot be opened ({problem})")
    return judge(path, tuple(map(int, output.split())))


def library_paths() -> tuple[str, ...]:
    """Find the libLLVM files of this machine, each once.

    Returns:
        Paths from the dynamic loader's cache, the usual folders of Linux and Homebrew, and conda's.
    """
    folders = [*_FOLDERS, f"{sys.base_prefix}/lib"]
    listed = [path for folder in folders for path in sorted(Path("/").glob(f"{folder[1:]}/libLLVM*"))]
    found: dict[Path, str] = {}
    for path in [*_loader_cache(), *listed]:
        if _NAME.fullmatch(path.name) and path.is_file():
            found.setdefault(path.resolve(), str(path))
    return tuple(found.values())


def candidates() -> tuple[Llvm, ...]:
    """Every libLLVM found on this machine, whatever `DRJIT_LIBLLVM_PATH` says.

    Returns:
        Usable before unusable, versions seen to work before others, newer before older.
    """
    libraries = map(inspect, library_paths())
    return tuple(sorted(libraries, key=lambda each: (each.usable, each.tried, each.version), reverse=True))


def select() -> Llvm:
    """Point Dr.Jit to the libLLVM that it shall use; to be called before Dr.Jit is imported.

    A library named by `DRJIT_LIBLLVM_PATH` is used or refused, never passed over. Without one, the best
    candidate is taken and `DRJIT_LIBLLVM_PATH` is set to it, for this process and those that it starts.

    Returns:
        The library in use.

    Raises:
        InputError: If no library is usable, if `DRJIT_LIBLLVM_PATH` names one that is missing or unusable, if
            Dr.Jit was imported earlier without a usable one, or if libatomic is missing.
    """
    require_libatomic()
    requested = os.environ.get(PATH_VARIABLE)
    if requested:
        library = inspect(requested)
        if not library.usable:
            best = next((each.path for each in candidates() if each.usable), None)
            way_out = f"use {best}" if best else f"have one searched for, after installing it: {remedy()}"
            raise InputError(f"{PATH_VARIABLE}={requested}: {library.problem}. Unset it to {way_out}")
    else:
        found = candidates()
        if not found or not found[0].usable:
            seen = "; ".join(f"{each.path}: {each.problem}" for each in found) or "none found"
            raise InputError(
                f"Without a CUDA GPU the ray tracer needs libLLVM {OLDEST_MAJOR} or newer ({seen}). "
                f"To install it: {remedy()}"
            )
        library = found[0]
    _refuse_loaded()
    os.environ[PATH_VARIABLE] = library.path
    return library


def cuda_device_count() -> int:
    """Number of GPUs that Mitsuba can trace on, which takes a CUDA driver and OptiX.

    Returns:
        The count; 0 where the driver or OptiX is missing, or `CUDA_VISIBLE_DEVICES` hides every device.
    """
    output, problem = _probe(_CUDA_PROBE)
    return int(output) if problem is None and output else 0


def mitsuba_variant() -> str:
    """The Mitsuba variant to trace with: on a CUDA GPU where there is one, as Sionna RT chooses, else LLVM.

    Returns:
        `"cuda_ad_mono_polarized"` or `"llvm_ad_mono_polarized"`.
    """
    return "cuda_ad_mono_polarized" if cuda_device_count() else "llvm_ad_mono_polarized"


def prepare() -> str:
    """Make Dr.Jit safe to import: picks the variant and, if that compiles with LLVM, the library.

    Returns:
        The Mitsuba variant to set before `sionna.rt` is imported.

    Raises:
        InputError: As `select` does on a machine without a usable GPU, and if libatomic is missing on any.
    """
    require_libatomic()
    variant = mitsuba_variant()
    if variant.startswith("llvm"):
        select()
    return variant


def require_libatomic() -> None:
    """Refuse a Linux without libatomic, which Dr.Jit links to and a bare Debian does not bring.

    Raises:
        InputError: If the library cannot be opened.
    """
    if sys.platform == "linux":
        try:
            ctypes.CDLL("libatomic.so.1")
        except OSError as error:
            raise InputError(f"Dr.Jit needs libatomic ({error}). To install it: {remedy()}") from error


def remedy() -> str:
    """The command that installs what the ray tracer needs beside Python packages on this machine.

    Returns:
        One line to paste into a shell, or advice where the package manager is not known.
    """
    sudo = "" if getattr(os, "geteuid", int)() == 0 else "sudo "
    if sys.platform == "darwin":
        return "brew install llvm"
    if shutil.which("apt-get"):
        return f"{sudo}apt-get update && {sudo}apt-get install libllvm19 libatomic1"
    if shutil.which("dnf"):
        return f"{sudo}dnf install llvm-libs libatomic"
    return f"install LLVM {max(TRIED_MAJORS)} and set {PATH_VARIABLE} to its libLLVM"


def _refuse_loaded() -> None:
    """Refuse a Dr.Jit that was imported already with an unusable library, which cannot be exchanged."""
    drjit = sys.modules.get("drjit")
    if drjit is None:
        return
    loaded = drjit.detail.llvm_version()
    if loaded[0] < OLDEST_MAJOR:
        state = "without libLLVM" if loaded[0] < 0 else f"with LLVM {loaded[0]}"
        raise InputError(
            f"Dr.Jit was imported {state}, and needs {OLDEST_MAJOR} or newer. Call calibray.tracing.llvm.prepare() "
            f"before importing sionna.rt, mitsuba or drjit, or set {PATH_VARIABLE}. To install one: "
            f"{remedy()}"
        )


def _loader_cache() -> list[Path]:
    """Paths in the cache of the dynamic loader that may be a libLLVM; none where there is no such cache."""
    # Some distributions keep ldconfig off the PATH of ordinary users.
    ldconfig = shutil.which("ldconfig", path=f"{os.environ.get('PATH', '')}:/sbin:/usr/sbin")
    if ldconfig is None:
        return []
    listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
    return [Path(match) for match in re.findall(r"=> (.*/libLLVM\S*)$", listing, re.MULTILINE)]


def _probe(code: str, *arguments: str) -> tuple[str, str | None]:
    """Run Python code in a bare interpreter; return its output and what went wrong, None if nothing did."""
    command = [sys.executable, "-I", "-S", "-c", code, *arguments]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return "", f"no answer within {PROBE_TIMEOUT:g} s"
    if run.returncode:
        reason = run.stderr.strip().splitlines()[-1:] or [f"the process ended with {run.returncode}"]
        return "", reason[0].removeprefix("OSError: ")
    return run.stdout.strip(), None


if __name__ == "__main__":
    try:
        chosen = prepare()
    except InputError as error:
        sys.stderr.write(f"Error: {error}\n")
        sys.exit(2)
    library_in_use = os.environ[PATH_VARIABLE] if chosen.startswith("llvm") else "needs no libLLVM"
    sys.stdout.write(f"{chosen}: {library_in_use}\n")
