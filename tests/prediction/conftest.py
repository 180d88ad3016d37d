"""What the tests of this room share: they compile fast."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _few_candidates(compiled_fast: None) -> None:
    """Each program is evaluated a few times."""
