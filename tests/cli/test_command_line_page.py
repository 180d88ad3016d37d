"""docs/command-line.md says what the commands say."""

import runpy
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]


def test_the_page_is_that_of_the_commands():
    tool = runpy.run_path(str(REPOSITORY / "tools" / "command_line.py"))
    page = (REPOSITORY / "docs" / "command-line.md").read_text(encoding="utf-8")
    assert page == tool["page"](), "run: python tools/command_line.py"
    assert "`calibray run`" in page
