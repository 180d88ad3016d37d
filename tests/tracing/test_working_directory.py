"""A scene is read from its own folder, wherever the shell stands."""

from __future__ import annotations

import pytest

from calibray.scenes import read_scene
from calibray.tracing.sionna.scene import load_scene, mi
from small_scenes import block, write_scene


@pytest.mark.parametrize("relative", [False, True])
def test_meshes_of_the_same_name_in_the_working_directory_are_not_loaded(
    tmp_path, monkeypatch, request, relative
):
    """Every made scene has the same names of meshes, so that a shell in the folder of one must not change another."""
    mine = write_scene(tmp_path / "mine", {"house": block((0, 0, 0), (10, 10, 5))})
    other = write_scene(tmp_path / "other", {"house": block((50, 50, 0), (90, 90, 30))})
    monkeypatch.chdir(other.parent)
    # Mitsuba searches the directory that was the working one when it was imported.
    started = mi.FileResolver(mi.file_resolver())
    started.prepend(str(other.parent))
    before = mi.file_resolver()
    mi.set_file_resolver(started)
    request.addfinalizer(lambda: mi.set_file_resolver(before))
    source = "../mine/scene.xml" if relative else str(mine)
    bounds = load_scene(read_scene(source, 3.5e9)).mi_scene.bbox()
    assert list(bounds.min) == pytest.approx([0, 0, 0], abs=1e-3)
    assert list(bounds.max) == pytest.approx([10, 10, 5], abs=1e-3)
