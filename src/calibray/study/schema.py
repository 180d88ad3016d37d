"""The JSON schema of study files, generated from the model that reads them."""

from __future__ import annotations

import json
from typing import Any

from calibray.study.study import Study


def schema_text() -> str:
    """The schema as JSON text with a line break at its end."""
    return json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"


def schema() -> dict[str, Any]:
    """JSON Schema, draft 2020-12; the first line of each docstring describes a table."""
    content = Study.model_json_schema()
    _shorten(content)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Calibray study"} | {
        key: value for key, value in content.items() if key != "title"
    }


def _shorten(node: Any) -> None:
    """Keep the first line of descriptions; the rest describes the attributes of Python classes."""
    if isinstance(node, dict):
        if isinstance(node.get("description"), str):
            node["description"] = node["description"].split("\n\n")[0].replace("\n", " ").replace("``", "")
        for part in node.values():
            _shorten(part)
    elif isinstance(node, list):
        for part in node:
            _shorten(part)
