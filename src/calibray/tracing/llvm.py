"""Decides whether the ray tracer runs on a GPU; if not, chooses the libLLVM with which Dr.Jit compiles its kernels.

Without CUDA, Dr.Jit loads the newest libLLVM that it finds, and an incompatible version aborts the whole process. The
choice is therefore made here, before Dr.Jit is imported. Every library is opened in a separate process, and
`DRJIT_LIBLLVM_PATH` is set to the path of the best one.

`python -m calibray.tracing.llvm` prints the Mitsuba variant and the library that the ray tracer will use. If no library
is usable, the command prints installation instructions and exits with status 2.
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
"""Environment variable with the path of Dr.Jit's libLLVM."""

OLDEST_MAJOR = 17
"""Oldest accepted major version.

Dr.Jit 1.5 rejects LLVM 14 and older versions, and aborts on x86 with LLVM 15 and 16 ("Cannot select: fminimum"). LLVM
has compiled `llvm.minimum` for x86 since version 17 (reviews.llvm.org D145634 and D148691).
"""

TESTED_MAJORS = frozenset({19, 22})
"""Major versions with which Sionna RT 2.2 was tested; other supported versions are accepted with a note."""

PROBE_TIMEOUT = 30.0
"""Time limit for opening one library [s]."""

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

# The pattern matches libLLVM-15.so.1, libLLVM-14.0.6.so.1, libLLVM.so.19.1 and libLLVM.dylib, but not libLLVM-C.dylib
# or libLLVMSupport.so, which are parts of LLVM.
_NAME = re.compile(r"libLLVM(?:-(\d+)[\d.]*)?\.(?:so(?:\.(\d+)[\d.]*)?|dylib)")

# LLVMGetVersion has existed since LLVM 16; without it, nothing is printed.
_VERSION_PROBE = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
if hasattr(library, "LLVMGetVersion"):
    numbers = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*map(ctypes.byref, numbers))
    print(*(number.value for number in numbers))
"""

# Mitsuba traces rays on a GPU with OptiX, so a CUDA driver alone is not enough.
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
    """A libLLVM library on this machine.

    Attributes:
        path: The file, or a bare name that the dynamic loader resolves.
        version: Major, minor and patch number, as far as known; empty if unknown.
        problem: The reason why Dr.Jit cannot use the library; None if it can.
    """

    path: str
    version: tuple[int, ...]
    problem: str | None

    @property
    def usable(self) -> bool:
        """Whether Dr.Jit can compile with this library."""
        return self.problem is None

    @property
    def tested(self) -> bool:
        """Whether the library is usable and its major version was tested."""
        return self.usable and self.version[0] in TESTED_MAJORS

    @property
    def label(self) -> str:
        """The version as text: `19.1.7`, or `unknown`."""
        return ".".join(map(str, self.version)) or "unknown"


def version_in_name(path: str) -> tuple[int, ...]:
    """Read the major version from a library's file name; empty if the name has none.

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
    """Decide whether Dr.Jit can use an opened library, given the version that the library reports (empty if none)."""
    version = reported or version_in_name(path)
    if not reported and (not version or version[0] >= 16):
        return Llvm(path, (), "it reports no LLVM version, unlike every libLLVM since version 16")
    if version[0] < OLDEST_MAJOR:
        return Llvm(path, version, f"LLVM {version[0]} is too old; Dr.Jit needs {OLDEST_MAJOR} or newer")
    return Llvm(path, version, None)


def inspect(path: str) -> Llvm:
    """Open a library (path or bare name) in a separate process, because a broken library can abort the process."""
    output, problem = _probe(_VERSION_PROBE, path)
    if problem is not None:
        return Llvm(path, version_in_name(path), f"it cannot be opened ({problem})")
    return judge(path, tuple(map(int, output.split())))


def library_paths() -> tuple[str, ...]:
    """Find each libLLVM file once: in the loader's cache and in the usual folders of Linux, Homebrew and conda."""
    folders = [*_FOLDERS, f"{sys.base_prefix}/lib"]
    listed = [path for folder in folders for path in sorted(Path("/").glob(f"{folder[1:]}/libLLVM*"))]
    by_file: dict[Path, str] = {}
    for path in [*_loader_cache(), *listed]:
        if _NAME.fullmatch(path.name) and path.is_file():
            by_file.setdefault(path.resolve(), str(path))
    return tuple(by_file.values())


def installed_libraries() -> tuple[Llvm, ...]:
    """Inspect every libLLVM on this machine; usable, tested and newer versions come first."""
    libraries = map(inspect, library_paths())
    return tuple(
        sorted(libraries, key=lambda library: (library.usable, library.tested, library.version), reverse=True)
    )


def select() -> Llvm:
    """Set Dr.Jit's libLLVM and return it; call this function before Dr.Jit is imported.

    A library named by `DRJIT_LIBLLVM_PATH` is either used or refused, never ignored. If the variable is not set, the
    best installed library is chosen, and the variable is set to its path for this process and its children.

    Raises:
        InputError: No library is usable, `DRJIT_LIBLLVM_PATH` names a library that is missing or unusable, Dr.Jit has
            already been imported without a usable library, or libatomic is missing.
    """
    require_libatomic()
    requested = os.environ.get(PATH_VARIABLE)
    if requested:
        library = inspect(requested)
        if not library.usable:
            best = next((other.path for other in installed_libraries() if other.usable), None)
            remedy = (
                f"Unset it to use {best}"
                if best
                else f"Install libLLVM ({install_command()}), and unset the variable"
            )
            raise InputError(f"{PATH_VARIABLE}={requested}: {library.problem}. {remedy}")
    else:
        libraries = installed_libraries()
        if not libraries or not libraries[0].usable:
            problems = "; ".join(f"{other.path}: {other.problem}" for other in libraries) or "none found"
            raise InputError(
                f"Without a CUDA GPU, the ray tracer needs libLLVM {OLDEST_MAJOR} or newer ({problems}). "
                f"To install it: {install_command()}"
            )
        library = libraries[0]
    _refuse_loaded()
    os.environ[PATH_VARIABLE] = library.path
    return library


def cuda_device_count() -> int:
    """Number of CUDA GPUs if OptiX is installed; 0 if `CUDA_VISIBLE_DEVICES` hides all GPUs."""
    output, problem = _probe(_CUDA_PROBE)
    return int(output) if problem is None and output else 0


def mitsuba_variant() -> str:
    """The Mitsuba variant for tracing: as in Sionna RT, CUDA if there is a GPU, otherwise LLVM."""
    return "cuda_ad_mono_polarized" if cuda_device_count() else "llvm_ad_mono_polarized"


def prepare() -> str:
    """Make Dr.Jit safe to import: choose a libLLVM if there is no usable GPU, and return the Mitsuba variant to set.

    Raises:
        InputError: libatomic is missing, or there is no usable GPU and `select` finds no usable library.
    """
    require_libatomic()
    variant = mitsuba_variant()
    if variant.startswith("llvm"):
        select()
    return variant


def require_libatomic() -> None:
    """Raise an error on Linux without libatomic, which Dr.Jit needs and minimal Debian installations lack.

    Raises:
        InputError: The library cannot be opened.
    """
    if sys.platform == "linux":
        try:
            ctypes.CDLL("libatomic.so.1")
        except OSError as error:
            raise InputError(
                f"Dr.Jit needs libatomic ({error}). To install it: {install_command()}"
            ) from error


def install_command() -> str:
    """One-line shell command that installs the system libraries, or advice if the package manager is unknown."""
    sudo = "" if getattr(os, "geteuid", int)() == 0 else "sudo "
    if sys.platform == "darwin":
        return "brew install llvm"
    if shutil.which("apt-get"):
        return f"{sudo}apt-get update && {sudo}apt-get install libllvm19 libatomic1"
    if shutil.which("dnf"):
        return f"{sudo}dnf install llvm-libs libatomic"
    return f"install LLVM {max(TESTED_MAJORS)} and set {PATH_VARIABLE} to its libLLVM"


def _refuse_loaded() -> None:
    """Raise an error if Dr.Jit was already imported with an unusable library, which can no longer be replaced."""
    drjit = sys.modules.get("drjit")
    if drjit is None:
        return
    loaded = drjit.detail.llvm_version()
    if loaded[0] < OLDEST_MAJOR:
        state = "without libLLVM" if loaded[0] < 0 else f"with LLVM {loaded[0]}"
        raise InputError(
            f"Dr.Jit was imported {state} and needs LLVM {OLDEST_MAJOR} or newer. Call calibray.tracing.llvm.prepare() "
            f"before importing sionna.rt, mitsuba or drjit, or set {PATH_VARIABLE}. To install one: {install_command()}"
        )


def _loader_cache() -> list[Path]:
    """Files in the dynamic loader's cache that might be libLLVM libraries; empty if there is no such cache."""
    # On some distributions, ldconfig is not on the PATH of ordinary users.
    ldconfig = shutil.which("ldconfig", path=f"{os.environ.get('PATH', '')}:/sbin:/usr/sbin")
    if ldconfig is None:
        return []
    listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
    return [Path(match) for match in re.findall(r"=> (.*/libLLVM\S*)$", listing, re.MULTILINE)]


def _probe(code: str, *arguments: str) -> tuple[str, str | None]:
    """Run Python code in an interpreter without site packages; return the output and the error, if any."""
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
