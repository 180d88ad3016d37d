"""The pages of docs/reference/command-line describe the commands."""

import runpy
from pathlib import Path

import typer

from calibray.cli.app import app

REPOSITORY = Path(__file__).parents[2]


def test_the_pages_describe_the_commands():
    tool = runpy.run_path(str(REPOSITORY / "tools" / "command_line.py"))
    folder = REPOSITORY / "docs" / "reference" / "command-line"
    committed = {file.name: file.read_text(encoding="utf-8") for file in folder.glob("*.md")}
    assert committed == tool["pages"](), "run: python tools/command_line.py"
    assert "`calibray run`" in committed["calibrate.md"]
    assert "| `--floor, --no-floor` | Make a floor. Default: `--floor`. |" in committed["prepare.md"]
    assert "| `--cell M` | Width of the cells [m]. Default: `5.0`. |" in committed["use-results.md"]


def test_help_contains_no_sections_for_python():
    helps = {name: command.help for name, command in typer.main.get_command(app).commands.items()}
    assert "Work on a study in the browser" in helps["open"]
    assert [name for name, text in helps.items() if "Raises" in text] == []
