"""Keys of ``[engine]`` that belong to another engine: checked, and kept for when that engine is chosen."""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from calibray.engines.kinds import DEFAULT, KINDS
from calibray.errors import InputError
from calibray.study.validation_errors import describe_fault
from calibray.support.messages import shortened
from calibray.support.strict_models import CLOSED


def split_engine_keys(content: Any, source: str) -> tuple[Any, dict[str, Any]]:
    """Split the table ``[engine]`` into the keys of the engine it names and those of other engines.

    A study may state how its program is called and yet use replay; `calibray run --engine command` then calls it.

    Raises:
        InputError: Another engine cannot use the value of its key.
    """
    # The study's own validation refuses a value that is not a table, or names no engine.
    name = content.get("name", DEFAULT) if isinstance(content, dict) else None
    if not isinstance(name, str) or name not in KINDS:
        return content, {}
    fields = {key: field for kind in KINDS.values() for key, field in kind.model_fields.items()}
    others = {
        key: value for key, value in content.items() if key in fields and key not in KINDS[name].model_fields
    }
    for key, value in others.items():
        _check(f"{source}: engine.{key} = {shortened(repr(value))}", fields[key], value)
    rest = {key: value for key, value in content.items() if key not in others}
    return {"name": DEFAULT, **rest}, others


def _check(prefix: str, field: FieldInfo, value: Any) -> None:
    # The type is composed at run time, which type checkers cannot follow.
    annotated: Any = Annotated
    checker = TypeAdapter[Any](annotated[field.annotation, Field(), *field.metadata], config=CLOSED)
    try:
        checker.validate_json(json.dumps(value, default=str))
    except ValidationError as error:
        raise InputError(f"{prefix}: {describe_fault(error.errors()[0])}") from None
