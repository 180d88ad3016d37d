"""The text of a study file: its TOML, and environment variables in the names of files."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calibray.errors import InputError
from calibray.study.sections import ParameterSection
from calibray.support.messages import shortened
from calibray.support.output_files import exists


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
