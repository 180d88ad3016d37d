"""The documentation: links, modules, commands and options exist, and pages are short."""

import re
import runpy
import tomllib
from pathlib import Path


def test_the_documentation_has_no_faults():
    tool = runpy.run_path(str(Path(__file__).parents[1] / "tools" / "check_docs.py"))
    assert tool["faults"]() == []
    assert list(tool["missing_modules"]("`no_such_module.py`")) == ["no_such_module.py"]
    # Put together here, where the check itself looks for commands.
    scripts = [f"benchmarks/{name}.py" for name in ("position_errors", "no_such")]
    text = f"python {scripts[0]} --first 4 \\\n    --no-such # --comment\n`python {scripts[1]}`"
    assert list(tool["missing_scripts"](text)) == [f"{scripts[0]} --no-such", scripts[1]]


def test_every_study_in_the_documentation_is_toml():
    root = Path(__file__).parents[1]
    for page in (root / "README.md", *sorted((root / "docs").rglob("*.md"))):
        for block in re.findall(
            r"^```toml\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
        ):
            try:
                tomllib.loads(block)
            except tomllib.TOMLDecodeError as error:
                raise AssertionError(f"{page.relative_to(root)}: {error}\n{block}") from error


def test_the_lock_file_follows_extras_of_packages_that_were_met_before(monkeypatch):
    tool = runpy.run_path(str(Path(__file__).parents[1] / "tools" / "lock.py"))
    requires = {"study": ["engine", "maps"], "maps": ["engine[fast]"], "engine": ["kernels; extra == 'fast'"]}
    monkeypatch.setattr(tool["metadata"], "requires", requires.get)
    monkeypatch.setattr(tool["metadata"], "version", lambda name: "1.0")
    found = {name for name, _ in tool["needed"]("study", frozenset(), {})}
    assert found == {"engine", "maps", "kernels"}
