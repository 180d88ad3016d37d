"""Optional libraries: missing, or installed and not loadable."""

import sys

import pytest

from calibray.errors import InputError
from calibray.support.lazy_imports import library


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
