"""Messages of errors."""

import pickle

import pytest

from calibray.errors import LONGEST_MESSAGE, EngineError, InputError


@pytest.mark.parametrize("kind", [InputError, EngineError])
def test_a_message_keeps_its_start_and_its_remedy_whatever_it_quotes(kind):
    """A value of the input may have any length."""
    error = kind(f"scene.xml: material {'x' * 60_000!r}: unknown; rename it")
    for message in (str(error), str(pickle.loads(pickle.dumps(error)))):
        assert len(message) <= LONGEST_MESSAGE
        assert message.startswith("scene.xml: material")
        assert message.endswith("unknown; rename it")
    assert str(kind("short")) == "short"
