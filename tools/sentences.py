"""Draw sentences at random from the docs, docstrings and messages, for proofreading.

python tools/sentences.py [--seed 0] [--count 50]
"""

from __future__ import annotations

import argparse
import ast
import random
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MIN_WORDS = 6


def main() -> None:
    """Print the sentences, each with the file that contains it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=50)
    options = parser.parse_args()
    pool = sorted({
        (sentence, path.relative_to(ROOT).as_posix())
        for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")]
        for text in (_strings(path) if path.suffix == ".py" else _paragraphs(path))
        for sentence in _sentences(text)
    })  # fmt: skip
    for number, (sentence, file) in enumerate(random.Random(options.seed).sample(pool, options.count), 1):
        sys.stdout.write(f"{number:3} {sentence}\n    {file}\n")


def _strings(path: Path) -> Iterator[str]:
    """Docstrings, and literal texts of at least `MIN_WORDS` words."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from re.split(r"\n\s*\n|\n\s*\w+: ", node.value)
        elif isinstance(node, ast.JoinedStr):
            parts = (part.value if isinstance(part, ast.Constant) else "..." for part in node.values)
            yield "".join(map(str, parts))


def _paragraphs(path: Path) -> Iterator[str]:
    """Paragraphs of prose: no code, tables or headings."""
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for paragraph in re.split(r"\n\s*\n|\n(?=[-*|#])", text):
        if not paragraph.lstrip().startswith(("|", "#", "<", "![")):
            yield paragraph


def _sentences(text: str) -> Iterator[str]:
    for sentence in re.split(r"(?<=[.!?])\s+", " ".join(text.split())):
        if len(re.findall(r"[A-Za-z]{2,}", sentence)) >= MIN_WORDS:
            yield sentence


if __name__ == "__main__":
    main()
