"""What the site has beyond the files under docs/: the API reference, notebooks, and a place for case studies.

These are hooks of MkDocs (`make site`). Pages link to files of the repository too, which are no part of the site: such
links become plain text there, and `tools/check_docs.py` checks them.
"""

from __future__ import annotations

import json
import re
from importlib import import_module
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

DOCS = Path(__file__).resolve().parents[1] / "docs"
NOTEBOOKS = DOCS.parent / "examples" / "notebooks"
ROOMS = {
    "calibray.engines": "Engines",
    "calibray.optimizers": "Optimizers",
}
_OUTSIDE = re.compile(r"\[([^\]]*)\]\((?:\.\./)+[^)\s]*\)")


def on_config(config: Any) -> Any:
    """Add the pages that come and go to the navigation.

    Args:
        config: The site's configuration.

    Returns:
        The same.
    """
    studies = [
        {_title(file): f"case-studies/{file.name}"} for file in sorted((DOCS / "case-studies").glob("*.md"))
    ]
    books = [{_title(file): f"notebooks/{file.stem}.md"} for file in sorted(NOTEBOOKS.glob("*.ipynb"))]
    before = len(config.nav) - 1
    config.nav[before:before] = [
        {name: pages} for name, pages in (("Notebooks", books), ("Case studies", studies)) if pages
    ]
    interface = [{"Calibray": "api/calibray.md"}, *({name: f"api/{room}.md"} for room, name in ROOMS.items())]
    config.nav.append({"Python": interface})
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made of code and of notebooks.

    Args:
        files: The site's files.
        config: The site's configuration.

    Returns:
        The same.
    """
    pages = {
        "api/calibray.md": _interface("calibray", "The public interface"),
        **{f"api/{room}.md": _interface(room, name) for room, name in ROOMS.items()},
    }
    pages |= {f"notebooks/{file.stem}.md": notebook(file) for file in sorted(NOTEBOOKS.glob("*.ipynb"))}
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Make text of links to what is no part of the site.

    Args:
        markdown: A page.

    Returns:
        The page.
    """
    return _OUTSIDE.sub(r"\1", markdown)


def notebook(file: Path) -> str:
    """A notebook as a page: its texts, and its code in blocks.

    Args:
        file: The notebook.

    Returns:
        Markdown.
    """
    parts = []
    for cell in json.loads(file.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def _title(file: Path) -> str:
    """The first heading of a page or a notebook."""
    text = notebook(file) if file.suffix == ".ipynb" else file.read_text(encoding="utf-8")
    found = re.search(r"^# (.+)$", text, re.MULTILINE)
    return file.stem if found is None else found[1]


def _interface(package: str, title: str) -> str:
    """The page of a package's public names, each described where it is defined."""
    loaded = import_module(package)
    named = [getattr(loaded, name) for name in sorted(loaded.__all__, key=str.lower)]
    homes = [f"{each.__module__}.{each.__qualname__}" for each in named if hasattr(each, "__qualname__")]
    return (
        "\n\n".join([f"# {title}", f"```python\nimport {package}\n```", *(f"::: {home}" for home in homes)])
        + "\n"
    )
