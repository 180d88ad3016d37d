"""The pages of docs/reference/command-line describe the commands."""

import runpy
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]


def test_the_pages_describe_the_commands():
    tool = runpy.run_path(str(REPOSITORY / "tools" / "command_line.py"))
    folder = REPOSITORY / "docs" / "reference" / "command-line"
    committed = {file.name: file.read_text(encoding="utf-8") for file in folder.glob("*.md")}
    assert committed == tool["pages"](), "run: python tools/command_line.py"
    assert "`calibray run`" in committed["calibrate.md"]
