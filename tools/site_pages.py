"""Hooks of MkDocs (`make site`): add the Python reference, the notebooks and the case studies to the site.

Pages also link to files of the repository outside docs/. These links become plain text in the site;
`tools/check_docs.py` checks them.
"""

from __future__ import annotations

import json
import os
import re
from importlib import import_module
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

DOCS = Path(__file__).resolve().parents[1] / "docs"
NOTEBOOKS = DOCS.parent / "examples" / "notebooks"
API = "reference/python"
ROOMS = {
    "calibray.result": "Result, sections",
    "calibray.engines": "Engines",
    "calibray.optimizers": "Optimizers",
}
_LINK = re.compile(r"\[([^\]]*)\]\(((?:\.\./)+[^)#\s]*)[^)]*\)")


def on_config(config: Any) -> Any:
    """Add generated pages to the navigation.

    Args:
        config: The site's configuration.

    Returns:
        The same configuration.
    """
    studies = [
        {_title(file): f"case-studies/{file.name}"} for file in sorted((DOCS / "case-studies").glob("*.md"))
    ]
    notebooks = [{_title(file): f"notebooks/{file.stem}.md"} for file in sorted(NOTEBOOKS.glob("*.ipynb"))]
    sections = {name: pages for section in config.nav for name, pages in section.items()}
    sections["Tutorial"] += notebooks
    sections["Measurements"] += studies
    sections["Reference"] += [{"Python": f"{API}/calibray.md"}]
    sections["Reference"] += [{f"Python, {name.lower()}": f"{API}/{room}.md"} for room, name in ROOMS.items()]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are generated from code and from notebooks.

    Args:
        files: The site's files.
        config: The site's configuration.

    Returns:
        The same files, with the new pages.
    """
    pages = {
        f"{API}/calibray.md": _interface("calibray", "The public interface"),
        **{f"{API}/{room}.md": _interface(room, name) for room, name in ROOMS.items()},
    }
    pages |= {f"notebooks/{file.stem}.md": notebook(file) for file in sorted(NOTEBOOKS.glob("*.ipynb"))}
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn links to files outside docs/ into plain text.

    Args:
        markdown: The text of a page.
        page: The page.

    Returns:
        The text.
    """
    folder = (DOCS / page.file.src_uri).parent

    def plain(match: re.Match[str]) -> str:
        target = Path(os.path.normpath(folder / match[2]))
        return match[0] if target.is_relative_to(DOCS) else match[1]

    return _LINK.sub(plain, markdown)


def notebook(file: Path) -> str:
    """Convert a notebook to Markdown: its text cells, and its code in blocks.

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
    heading = re.search(r"^# (.+)$", text, re.MULTILINE)
    return file.stem if heading is None else heading[1]


def _interface(package: str, title: str) -> str:
    """The page of a package's public names, each described where it is defined."""
    loaded = import_module(package)
    exports = [getattr(loaded, name) for name in sorted(loaded.__all__, key=str.lower)]
    homes = [
        f"{value.__module__}.{value.__qualname__}" for value in exports if hasattr(value, "__qualname__")
    ]
    return (
        "\n\n".join([f"# {title}", f"```python\nimport {package}\n```", *(f"::: {home}" for home in homes)])
        + "\n"
    )
