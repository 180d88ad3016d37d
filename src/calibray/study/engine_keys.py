"""Keys of ``[engine]`` that are another engine's: kept for when it is chosen, and checked all the same."""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from calibray.engines.kinds import DEFAULT, KINDS
from calibray.errors import InputError
from calibray.study.validation_errors import words
from calibray.support.messages import shortened
from calibray.support.strict_models import CLOSED


def part_engine(content: Any, source: str) -> tuple[Any, dict[str, Any]]:
    """Part the table ``[engine]`` into the keys of the engine named there and those of others.

    A study may say how its program is called and yet run on replay: `calibray run --engine command` takes it up.

    Args:
        content: The table as the file gives it.
        source: Name of the file, for messages.

    Returns:
        What is the named engine's, the name put in where it is left out, and keys that only others know.

    Raises:
        InputError: A value that another engine would take up is impossible for it.
    """
    # What is no table, or names no kind, is refused by the study itself.
    name = content.get("name", DEFAULT) if isinstance(content, dict) else None
    if not isinstance(name, str) or name not in KINDS:
        return content, {}
    own = KINDS[name].model_fields
    known = {key: field for kind in KINDS.values() for key, field in kind.model_fields.items()}
    others = {key: value for key, value in content.items() if key not in own and key in known}
    for key, value in others.items():
        _check(f"{source}: engine.{key} = {shortened(repr(value))}", known[key], value)
    rest = {key: value for key, value in content.items() if key not in others}
    return {"name": DEFAULT, **rest}, others


def _check(place: str, field: FieldInfo, value: Any) -> None:
    # Put together at run time, which no checker of types can follow.
    annotated: Any = Annotated
    checker = TypeAdapter[Any](annotated[field.annotation, Field(), *field.metadata], config=CLOSED)
    try:
        checker.validate_json(json.dumps(value, default=str))
    except ValidationError as error:
        raise InputError(f"{place}: {words(error.errors()[0])}") from None
