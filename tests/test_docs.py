"""The documentation: links, modules, commands and options exist, and pages are short."""

import runpy
from pathlib import Path


def test_the_documentation_has_no_faults():
    tool = runpy.run_path(str(Path(__file__).parents[1] / "tools" / "check_docs.py"))
    assert tool["faults"]() == []
    assert list(tool["missing_modules"]("`no_such_module.py`")) == ["no_such_module.py"]
