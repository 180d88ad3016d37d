"""Names loaded on first use; optional libraries that are missing, or installed and not loadable."""

import sys
from importlib import import_module

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
        InputError, match=r"shaky is installed but cannot be loaded \(libgeos\.so: .*memory is low"
    ):
        library("shaky", "scenes")
    monkeypatch.setitem(sys.modules, "absent", None)
    with pytest.raises(InputError, match=r"absent is not installed .*calibray\[scenes\]"):
        library("absent", "scenes")


@pytest.mark.parametrize("room", ["engines", "scenes.authoring", "study"])
def test_every_name_of_a_room_is_loaded_from_its_module(room):
    module = import_module(f"calibray.{room}")
    assert [name for name in module.__all__ if not hasattr(module, name)] == []
    assert set(module.__all__) <= set(dir(module))
    assert not hasattr(module, "nothing")
