"""The text of a study file: its TOML, the names in it, and the variables in its file names."""

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
    """Read the content of a study file.

    Args:
        path: The TOML file.

    Returns:
        Sections by name.

    Raises:
        InputError: The file does not exist, cannot be read, or is no TOML.
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
        # A number of thousands of digits, or lists thousands deep, beside what TOML itself refuses.
        raise InputError(f"{path}: not valid TOML: {shortened(str(error), 300)}") from None


def refuse_unquoted_names(parameters: Any, path: str | Path) -> None:
    """Refuse ``walls.thickness = ...``, which TOML reads as a table "walls" with a key "thickness"."""
    for name, entry in parameters.items() if isinstance(parameters, Mapping) else ():
        fields = entry if isinstance(entry, Mapping) else {}
        tables = (key for key, value in fields.items() if isinstance(value, Mapping))
        if field := next((key for key in tables if key not in ParameterSection.model_fields), None):
            raise InputError(
                f'{path}: parameters.{name}.{field}: quote the name, "{name}.{field}" = {{ ... }}'
            )


def expand(text: str, environment: Mapping[str, str]) -> str:
    """Put in environment variables: ``${NAME}``, or ``${NAME:-default}`` where one may be unset or empty.

    Args:
        text: The text.
        environment: The variables.

    Returns:
        The text with every variable replaced.

    Raises:
        InputError: A variable without default is not set, or a ``${`` is malformed.

    Example:
        >>> expand("${HERE:-there}/links.csv", {})
        'there/links.csv'
    """

    def value(match: re.Match[str]) -> str:
        name, default = match.groups()
        if found := environment.get(name):
            return found
        if default is None:
            raise InputError(f"environment variable {name} is not set; set it, or write ${{{name}:-DEFAULT}}")
        return default

    expanded, count = re.subn(r"\$\{([A-Za-z_]\w*)(?::-([^{}]*))?\}", value, text)
    if text.count("${") != count:
        raise InputError("malformed ${...}; write ${NAME} or ${NAME:-DEFAULT}")
    return expanded
