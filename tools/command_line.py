"""Write the pages of docs/reference/command-line from the commands themselves.

Usage, in an environment where Calibray is installed: `python tools/command_line.py`
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import typer

from calibray.cli.app import app

FOLDER: Final = Path(__file__).resolve().parents[1] / "docs" / "reference" / "command-line"

PAGES: Final = {
    "calibrate.md": ("Commands: calibrate", ("demo", "run", "trace", "validate", "compare", "ledger")),
    "use-results.md": ("Commands: use a result", ("predict", "map", "suggest", "report", "export")),
    "prepare.md": ("Commands: prepare", ("doctor", "open", "scene", "init", "schema", "cache")),
}
"""Title and commands of every page."""

HEAD: Final = """Data goes to stdout, progress and messages to stderr. The exit status is 0 for success, 1 for a failure
at run time, 2 for bad input, 130 after Ctrl-C, and 143 after SIGTERM. Progress is a bar on a terminal, and otherwise a
line every few seconds. `python tools/command_line.py` writes this page from the commands.
"""


def pages() -> dict[str, str]:
    """Write the pages.

    Returns:
        The text of each page by file name.

    Raises:
        KeyError: A command is on no page, or a page names a command that does not exist.
    """
    root: Any = typer.main.get_command(app)
    listed = [name for _, names in PAGES.values() for name in names]
    if sorted(listed) != sorted(root.commands):
        raise KeyError(f"PAGES differs from the commands: {sorted(set(listed) ^ set(root.commands))}")
    return {file: page(title, names, root) for file, (title, names) in PAGES.items()}


def page(title: str, names: tuple[str, ...], root: Any) -> str:
    """Write one page: every command with its arguments."""
    parts = [f"# {title}\n", HEAD]
    for name in names:
        for full_name, command in with_subcommands(name, root.commands[name]):
            summary = (command.help or "").strip().split("\n\n")[0].replace("\n", " ")
            rows = [row(parameter) for parameter in command.params if parameter.name != "help"]
            table = ["| argument | meaning |", "|---|---|", *rows, ""] if rows else []
            parts += [f"## `calibray {full_name}`", "", summary, "", *table]
    return "\n".join(parts).rstrip() + "\n"


def with_subcommands(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    """A command, then the commands of its group, by full name."""
    yield name, command
    for sub, subcommand in sorted(getattr(command, "commands", {}).items()):
        yield f"{name} {sub}", subcommand


def row(parameter: Any) -> str:
    """The table row of one argument or option."""
    metavar = parameter.metavar or ""
    name = (
        metavar
        if parameter.param_type_name == "argument"
        else " ".join([", ".join([*parameter.opts, *parameter.secondary_opts]), metavar]).strip()
    )
    default = parameter.default
    if isinstance(default, bool) and parameter.secondary_opts:
        default = (parameter.opts if default else parameter.secondary_opts)[0]
    shown = not (default is None or default is False or parameter.required or callable(default))
    return f"| `{name}` | {parameter.help}{f' Default: `{default}`.' if shown else ''} |"


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for file, text in pages().items():
        (FOLDER / file).write_text(text, encoding="utf-8")
