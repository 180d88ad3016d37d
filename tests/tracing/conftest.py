"""What the tests of this room share: they compile fast, and several trace one scene."""

from pathlib import Path

import pytest

from small_scenes import block, write_scene


@pytest.fixture(scope="module", autouse=True)
def _few_candidates(compiled_fast: None) -> None:
    """Each trace is evaluated a few times."""


@pytest.fixture(scope="session")
def yard_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene: a ground with a house in the middle and a second house."""
    ground = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    houses = {"house": block((-5, -5, 0), (5, 5, 8)), "other": block((-5, 15, 0), (25, 20, 9))}
    return write_scene(tmp_path_factory.mktemp("yard"), {"ground": ground, **houses})
