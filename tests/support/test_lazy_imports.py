"""Optional libraries: missing, or installed and not loadable."""

import subprocess
import sys
from importlib import import_module

import pytest

from calibray.errors import InputError
from calibray.support.lazy_imports import after_import, library


def test_a_library_that_cannot_be_loaded_is_not_called_missing(tmp_path, monkeypatch):
    """With too little memory the system cannot map a library."""
    (tmp_path / "shaky.py").write_text(
        "raise ImportError('libgeos.so: failed to map segment from shared object')"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        InputError, match=r"shaky is installed but cannot be loaded \(libgeos\.so: .*memory is short"
    ):
        library("shaky", "scenes")
    monkeypatch.setitem(sys.modules, "absent", None)
    with pytest.raises(InputError, match=r"absent is not installed .*calibray\[scenes\]"):
        library("absent", "scenes")


def test_an_action_follows_an_import_that_came_before_or_comes_later(tmp_path, monkeypatch):
    (tmp_path / "follower_of_tests.py").write_text("value = 1")
    monkeypatch.syspath_prepend(tmp_path)
    done, finders = [], list(sys.meta_path)
    after_import("follower_of_tests", lambda module: done.append(module.value))
    import_module("json")
    assert not done
    module = import_module("follower_of_tests")
    assert (done, sys.meta_path) == ([1], finders)
    module.value = 2
    after_import("follower_of_tests", lambda module: done.append(module.value))
    assert done == [1, 2]


def test_calibray_enlarges_the_hash_table_of_sionna_imported_later():
    name = "sionna.rt.path_solvers.sb_candidate_generator"
    code = f"import calibray, {name} as later; print(later.SBCandidateGenerator.MIN_SPEC_COUNT_SIZE)"
    command = [sys.executable, "-W", "ignore", "-c", code]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "16777213\n"
