"""The text of a study file: its TOML, environment variables in the names of files, and keys of several engines."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from calibray.engines.kinds import DEFAULT, KINDS
from calibray.errors import InputError
from calibray.study.sections import ParameterSection
from calibray.study.validation_errors import describe_fault
from calibray.support.messages import shortened
from calibray.support.output_files import exists
from calibray.support.strict_models import CLOSED


def read_content(path: Path) -> dict[str, Any]:
    """Read the sections of a study file.

    Raises:
        InputError: The file does not exist, cannot be read, or is not TOML.
    """
    if not exists(path):
        raise InputError(f"{shortened(str(path), 300)}: no such study file")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not UTF-8 text; save it as UTF-8") from None
    except (ValueError, RecursionError) as error:
        # Besides malformed TOML: a number with thousands of digits, or lists nested thousands deep.
        raise InputError(f"{path}: not valid TOML: {shortened(str(error), 300)}") from None


def refuse_unquoted_names(parameters: Any, path: str | Path) -> None:
    """Refuse ``walls.thickness = ...``: TOML reads it as a table "walls" with a key "thickness"."""
    for name, entry in parameters.items() if isinstance(parameters, Mapping) else ():
        for key, value in entry.items() if isinstance(entry, Mapping) else ():
            if isinstance(value, Mapping) and key not in ParameterSection.model_fields:
                raise InputError(
                    f'{path}: parameters.{name}.{key}: quote the name, "{name}.{key}" = {{ ... }}'
                )


def expand(text: str, environment: Mapping[str, str]) -> str:
    """Replace environment variables: ``${NAME}``, or ``${NAME:-default}`` if one may be unset or empty.

    Raises:
        InputError: A variable without default is not set, or a ``${`` is malformed.

    Example:
        >>> expand("${HERE:-there}/links.csv", {})
        'there/links.csv'
    """

    def value(match: re.Match[str]) -> str:
        name, default = match.groups()
        if environment.get(name):
            return environment[name]
        if default is None:
            raise InputError(f"environment variable {name} is not set; set it, or write ${{{name}:-DEFAULT}}")
        return default

    expanded, count = re.subn(r"\$\{([A-Za-z_]\w*)(?::-([^{}]*))?\}", value, text)
    if text.count("${") != count:
        raise InputError("malformed ${...}; write ${NAME} or ${NAME:-DEFAULT}")
    return expanded


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
