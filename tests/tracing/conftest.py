"""A scene that several tests of this room trace."""

from pathlib import Path

import pytest

from small_scenes import block, write_scene


@pytest.fixture(scope="session")
def yard_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene: a ground with a house in the middle and a second house."""
    ground = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    houses = {"house": block((-5, -5, 0), (5, 5, 8)), "other": block((-5, 15, 0), (25, 20, 9))}
    return write_scene(tmp_path_factory.mktemp("yard"), {"ground": ground, **houses})
