"""The choice of libLLVM, checked with real libraries: this machine's own, and others under false names."""

from __future__ import annotations

import ctypes
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy.random.bit_generator
import pytest

from calibray.errors import InputError
from calibray.tracing import llvm
from calibray.tracing.llvm import Llvm

ELSEWHERE = "/usr/lib/libLLVM"


@pytest.fixture
def other_library(tmp_path):
    """A shared library that opens and is no LLVM, under the name asked for."""

    def named(name: str) -> Path:
        return Path(shutil.copy(numpy.random.bit_generator.__file__, tmp_path / name))

    return named


@pytest.fixture
def machine(monkeypatch):
    """A machine without GPU that holds the given libraries, none of them requested or loaded yet."""

    def holding(*libraries: Llvm) -> None:
        # setenv first, so that whatever the test sets is taken back at its end.
        monkeypatch.setenv(llvm.PATH_VARIABLE, "")
        monkeypatch.delitem(sys.modules, "drjit", raising=False)
        by_path = {library.path: library for library in libraries}
        monkeypatch.setattr(llvm, "library_paths", lambda: tuple(by_path))
        monkeypatch.setattr(llvm, "inspect", by_path.__getitem__)
        monkeypatch.setattr(llvm, "cuda_device_count", lambda: 0)

    return holding


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-14.so.1", (14,)),
        ("libLLVM-14.0.6.so.1", (14,)),
        ("libLLVM-19.so", (19,)),
        ("libLLVM.so.19.1", (19,)),
        ("libLLVM-19.dylib", (19,)),
        ("libLLVM.so", ()),
        ("libLLVM.dylib", ()),
        ("libLLVM-C.dylib", ()),
        ("libLLVMSupport.so.19", ()),
        ("libLLVM-19-rust-1.78.so", ()),
    ],
)
def test_the_name_tells_the_major_version(name, version):
    assert llvm.version_in_name(f"/usr/lib/{name}") == version


@pytest.mark.parametrize("version", [(17, 0, 6), (18, 1, 8), (19, 1, 7), (22, 1, 8), (40, 0, 0)])
def test_versions_from_17_on_are_accepted(version):
    library = llvm.judge(ELSEWHERE, version)
    assert library.usable
    assert library.tested == (version[0] in {19, 22})
    assert library.label == ".".join(map(str, version))


@pytest.mark.parametrize("version", [(14, 0, 6), (15, 0, 6), (16, 0, 6)])
def test_versions_that_abort_are_refused(version):
    library = llvm.judge(ELSEWHERE, version)
    assert not library.usable
    assert not library.tested
    assert "too old" in library.problem


def test_a_missing_library_is_told_with_its_path(tmp_path):
    path = str(tmp_path / "libLLVM.so.19.1")
    library = llvm.inspect(path)
    assert library.version == (19,)
    assert path in library.problem


def test_a_library_that_is_no_library_is_unusable(tmp_path):
    path = tmp_path / "libLLVM.so.19.1"
    path.write_text("not an ELF file")
    assert "cannot be opened" in llvm.inspect(str(path)).problem


def test_another_library_named_like_a_new_llvm_is_unusable(other_library):
    library = llvm.inspect(str(other_library("libLLVM.so.19.1")))
    assert library.version == ()
    assert "reports no LLVM version" in library.problem


def test_a_library_too_old_to_report_its_version_is_known_by_its_name(other_library):
    # LLVMGetVersion came with LLVM 16.
    library = llvm.inspect(str(other_library("libLLVM-15.so.1")))
    assert library.version == (15,)
    assert "too old" in library.problem


def test_a_library_that_kills_its_process_kills_only_that(monkeypatch):
    monkeypatch.setattr(llvm, "_VERSION_PROBE", "import os; os.abort()")
    assert "the process ended with -6" in llvm.inspect("libLLVM.so.19.1").problem


def test_a_library_that_hangs_is_given_up(monkeypatch):
    monkeypatch.setattr(llvm, "_VERSION_PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(llvm, "PROBE_TIMEOUT", 0.2)
    assert "no answer within 0.2 s" in llvm.inspect("libLLVM.so.19.1").problem


def test_files_are_found_in_the_usual_folders_once_under_all_names(other_library, tmp_path, monkeypatch):
    library = other_library("libLLVM.so.19.1")
    (tmp_path / "libLLVM-19.so").symlink_to(library)
    (tmp_path / "libLLVM-C.so").symlink_to(library)
    (tmp_path / "libLLVM-18.so").symlink_to(tmp_path / "gone")
    monkeypatch.setattr(llvm, "_FOLDERS", (str(tmp_path),))
    monkeypatch.setattr(llvm, "_loader_cache", lambda: [library])
    monkeypatch.setattr(sys, "base_prefix", str(tmp_path / "none"))
    assert llvm.library_paths() == (str(library),)


def test_the_loader_cache_is_read_where_there_is_one():
    assert all(path.name.startswith("libLLVM") for path in llvm._loader_cache())


def test_known_good_comes_first_then_the_newest(machine):
    untried, known, older, old = (
        llvm.judge(f"{ELSEWHERE}-{version[0]}.so", version)
        for version in [(23, 1, 0), (22, 1, 8), (19, 1, 7), (15, 0, 6)]
    )
    machine(old, older, untried, known)
    assert llvm.installed_libraries() == (known, older, untried, old)
    assert llvm.select() == known
    assert os.environ[llvm.PATH_VARIABLE] == known.path


@pytest.mark.parametrize("versions", [[], [(14,), (15,)]])
def test_without_a_usable_one_the_command_is_given(machine, monkeypatch, versions):
    libraries = [llvm.judge(f"{ELSEWHERE}-{version[0]}.so.1", version) for version in versions]
    machine(*libraries)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(shutil, "which", lambda command: command if command == "apt-get" else None)
    with pytest.raises(InputError, match="apt-get install libllvm19") as caught:
        llvm.prepare()
    assert all(library.path in str(caught.value) for library in libraries)
    assert os.environ[llvm.PATH_VARIABLE] == ""


@pytest.mark.parametrize("call", [llvm.select, llvm.prepare])
def test_without_libatomic_the_command_is_given(machine, monkeypatch, call):
    def missing(name: str) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    machine(llvm.judge(ELSEWHERE, (19, 1, 7)))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", missing)
    with pytest.raises(InputError, match=r"libatomic\.so\.1.*To install it"):
        call()


def test_a_gpu_needs_no_llvm(machine, monkeypatch):
    machine()
    monkeypatch.setattr(llvm, "cuda_device_count", lambda: 1)
    assert llvm.prepare() == "cuda_ad_mono_polarized"


@pytest.mark.parametrize("name", ["libLLVM.so.19.1", "libLLVM-15.so.1"])
def test_a_requested_library_is_refused_not_passed_over(other_library, monkeypatch, name):
    path = str(other_library(name))
    monkeypatch.setenv(llvm.PATH_VARIABLE, path)
    with pytest.raises(InputError, match=rf"DRJIT_LIBLLVM_PATH={path}: "):
        llvm.select()


def test_a_requested_missing_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv(llvm.PATH_VARIABLE, str(tmp_path / "libLLVM.so"))
    with pytest.raises(InputError, match="Unset it"):
        llvm.select()


@pytest.mark.parametrize(
    ("loaded", "state"), [((15, 0, 6), "with LLVM 15"), ((-1, -1, -1), "without libLLVM")]
)
def test_a_drjit_that_already_has_an_unusable_one_is_refused(machine, monkeypatch, loaded, state):
    machine(llvm.judge(ELSEWHERE, (19, 1, 7)))
    drjit = SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: loaded))
    monkeypatch.setitem(sys.modules, "drjit", drjit)
    with pytest.raises(InputError, match=state):
        llvm.select()


@pytest.mark.parametrize(
    ("platform", "tools", "command"),
    [
        ("darwin", {"apt-get"}, "brew install llvm"),
        ("linux", {"apt-get", "dnf"}, "apt-get install libllvm19 libatomic1"),
        ("linux", {"dnf"}, "dnf install llvm-libs libatomic"),
        ("linux", set(), "set DRJIT_LIBLLVM_PATH"),
    ],
)
def test_the_remedy_fits_the_platform(monkeypatch, platform, tools, command):
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(shutil, "which", lambda name: name if name in tools else None)
    assert command in llvm.install_command()


def test_without_a_cuda_driver_there_is_no_device(monkeypatch, tmp_path):
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", str(tmp_path / "libcuda.so"))
    assert llvm.cuda_device_count() == 0
    assert llvm.mitsuba_variant() == "llvm_ad_mono_polarized"


def test_this_machine_can_trace():
    # What `make setup` has ensured: a GPU, or an LLVM that Dr.Jit takes and that compiles fminimum.
    code = (
        "from calibray.tracing import llvm; variant = llvm.prepare()\n"
        "import importlib, drjit\n"
        "Float = importlib.import_module('drjit.' + variant.split('_')[0]).Float\n"
        "print(variant, drjit.sum(drjit.minimum(drjit.arange(Float, 4), 2.0))[0])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split()[1] == "5.0"


def test_the_module_tells_the_choice_or_the_remedy(tmp_path, monkeypatch, capsys):
    command = [sys.executable, "-m", "calibray.tracing.llvm"]
    good = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (good.returncode, good.stderr) == (0, "")
    assert "_ad_mono_polarized: " in good.stdout
    nowhere = str(tmp_path / "none.so")
    monkeypatch.setenv(llvm.PATH_VARIABLE, nowhere)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    with pytest.raises(SystemExit) as bad:
        runpy.run_path(llvm.__file__, run_name="__main__")
    printed = capsys.readouterr()
    assert (bad.value.code, printed.out) == (2, "")
    assert printed.err.startswith(f"Error: DRJIT_LIBLLVM_PATH={nowhere}: ")
