"""What the tests of this room share: they call inner functions of `calibray.fields` under its JAX settings."""

from collections.abc import Iterator

import pytest

from calibray.fields import jax_settings


@pytest.fixture(scope="module", autouse=True)
def _jax_settings(_compiled_fast: None) -> Iterator[None]:
    with jax_settings():
        yield
