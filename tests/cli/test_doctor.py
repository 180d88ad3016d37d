"""`calibray doctor` reports the real state of this machine and of broken ones."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib import metadata

import pytest

from calibray import doctor as diagnosis
from calibray.doctor import Check, Diagnosis
from calibray.tables import render
from calibray.tracing import llvm

OLD = llvm.Llvm("/usr/lib/libLLVM-15.so.1", (15,), "LLVM 15 is too old")
SOUND = Diagnosis(
    versions=(("python", "3.11.2"), ("pyarrow", "not installed: pip install 'calibray[parquet]'")),
    variant="llvm_ad_mono_polarized",
    cuda_devices=0,
    libraries=(llvm.Llvm("/usr/lib/libLLVM.so.19.1", (19, 1, 7), None), OLD),
    checks=(Check("LLVM", True, "19.1.7", "install LLVM"), Check("JAX", True, "cpu:0", "install JAX")),
)


@pytest.fixture(scope="module")
def here():
    """The diagnosis of the machine that runs the tests."""
    patch = pytest.MonkeyPatch()
    patch.delitem(sys.modules, "drjit", raising=False)
    yield diagnosis.examine()
    patch.undo()


def test_this_machine_works(here):
    assert here.usable, render(here.table())
    assert [check.name for check in here.checks[-3:]] == ["Dr.Jit", "Sionna RT", "JAX"]
    assert here.checks[-2].detail == "7 paths in a closed box"


def test_versions_are_those_installed(here):
    versions = dict(here.versions)
    for package in ("calibray", "sionna-rt", "mitsuba", "drjit", "jax", "numpy", "scipy"):
        assert versions[package] == metadata.version(package)
    assert versions["python"] == sys.version.split()[0]
    assert "pyarrow" in versions
    assert not {"pytest", "ruff", "mkdocs"} & set(versions)


def test_a_missing_package_has_its_install_command(monkeypatch):
    requirements = ["numpy>=2.0", "cma<5,>=3; extra == 'cma'", "ruff>=0.9; extra == 'lint'"]
    monkeypatch.setattr(metadata, "requires", lambda name: requirements)
    monkeypatch.setattr(diagnosis, "_version", {"calibray": "0.1.0"}.get)
    versions = dict(diagnosis.versions())
    assert versions["numpy"] == "not installed: pip install numpy"
    assert versions["cma"] == "not installed: pip install 'calibray[cma]'"
    assert "ruff" not in versions


@pytest.mark.parametrize(
    ("code", "detail"),
    [
        (
            "import os, sys; sys.stderr.write('LLVM ERROR\\nstack\\n'); sys.stderr.flush(); os.abort()",
            "SIGABRT: LLVM",
        ),
        ("raise RuntimeError('the LLVM backend is inactive')", "RuntimeError: the LLVM backend is inactive"),
        (
            "try: import no_such\nexcept ImportError: no_name",
            "ModuleNotFoundError: No module named 'no_such'; Name",
        ),
        ("import sys; sys.exit('6 paths in a closed box, not 7')", "6 paths in a closed box, not 7"),
        ("import os; os._exit(3)", "exit status 3"),
    ],
)
def test_a_check_whose_process_dies_has_failed(code, detail):
    check = diagnosis.run_check("Dr.Jit", code, (), "another LLVM")
    assert not check.passed
    assert detail in check.detail


def test_a_check_that_hangs_has_failed(monkeypatch):
    monkeypatch.setattr(diagnosis, "CHECK_TIMEOUT", 0.2)
    assert not diagnosis.run_check("Dr.Jit", "import time; time.sleep(60)", (), "").passed


def test_without_llvm_later_checks_are_skipped(monkeypatch, tmp_path):
    monkeypatch.setenv(llvm.PATH_VARIABLE, str(tmp_path / "libLLVM.so.19.1"))
    (check,) = diagnosis.check_tracing("llvm_ad_mono_polarized")
    assert not check.passed
    assert str(tmp_path) in check.remedy


def test_an_untested_library_is_marked(monkeypatch):
    untried = llvm.judge("/usr/lib/libLLVM.so.40.1", (40, 1, 0))
    monkeypatch.setattr(llvm, "select", lambda: untried)
    monkeypatch.setattr(diagnosis, "run_check", lambda name, *_: Check(name, False, "", ""))
    checks = diagnosis.check_tracing("llvm_ad_mono_polarized")
    assert [check.name for check in checks] == ["LLVM", "Dr.Jit"]
    assert "versions known to work: [19, 22]" in checks[0].detail


def test_the_table_has_versions_libraries_and_verdict():
    text = render(SOUND.table())
    assert "pip install 'calibray[parquet]'" in text
    assert f"{OLD.path}, {OLD.problem}" in text
    assert "To do" not in text
    assert text.splitlines()[-1].startswith("Verdict")
    assert text.endswith("Calibray works on this machine")


def test_one_failed_check_makes_the_machine_unusable():
    broken = replace(SOUND, checks=(SOUND.checks[0], Check("JAX", False, "no module", "install JAX")))
    assert not broken.usable
    assert "To do" in render(broken.table())
    assert render(broken.table()).count("install JAX") == 1
