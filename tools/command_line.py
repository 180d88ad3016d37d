"""Write docs/command-line.md from the commands themselves.

Usage, in an environment where Calibray is installed: `python tools/command_line.py`
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from calibray.cli.app import app

PAGE = Path(__file__).resolve().parents[1] / "docs" / "command-line.md"
HEAD = """# The command line

Data goes to stdout, progress and messages to stderr. The exit status is 0 for done, 1 for failed while running, 2 for
bad input, 130 for Ctrl-C. Progress is a bar on a terminal, and elsewhere a line every few seconds. This page is written
by `python tools/command_line.py`.
"""


def page() -> str:
    """The page's text: every command with its arguments."""
    parts = [HEAD]
    for name, command in commands(typer.main.get_command(app)):
        summary = (command.help or "").strip().split("\n\n")[0].replace("\n", " ")
        rows = [row(parameter) for parameter in command.params if parameter.name != "help"]
        table = ["| argument | meaning |", "|---|---|", *rows, ""] if rows else []
        parts += [f"## `calibray {name}`", "", summary, "", *table]
    return "\n".join(parts).rstrip() + "\n"


def commands(group: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Every command by name, those of a group of commands after it."""
    for name, command in sorted(group.commands.items()):
        yield before + name, command
        if hasattr(command, "commands"):
            yield from commands(command, f"{before}{name} ")


def row(parameter: Any) -> str:
    """The table row of one argument or option."""
    metavar = parameter.metavar or ""
    name = (
        metavar
        if parameter.param_type_name == "argument"
        else " ".join([", ".join(parameter.opts), metavar]).strip()
    )
    return f"| `{name}` | {parameter.help} |"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
