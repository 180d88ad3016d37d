"""Draw sentences at random from the docs, docstrings and messages, for proofreading.

python tools/sentences.py [--seed 0] [--count 50] [--among sionna.rt scipy.optimize]

With `--among`, whole sentences are mixed with as many from installed packages, as a control: a reader who does not know
the sources judges both. The sources follow after the sentences.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import random
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MIN_WORDS = 6
MAX_LENGTH = 260  # of a sentence that is mixed with others [characters]


def main() -> None:
    """Print the sentences, each with the file that contains it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--among", nargs="+", metavar="PACKAGE")
    options = parser.parse_args()
    files = [*(ROOT / "src").rglob("*.py"), *(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")]
    draw, pool = random.Random(options.seed), _pool(files)
    if options.among is None:
        for number, (sentence, file) in enumerate(draw.sample(pool, options.count), 1):
            sys.stdout.write(f"{number:3} {sentence}\n    {file.relative_to(ROOT)}\n")
        return
    mixed = [(sentence, "this project") for sentence in draw.sample(_whole(pool), options.count)]
    for index, package in enumerate(options.among):
        count = len(range(index, options.count, len(options.among)))
        theirs = _whole(_pool(_modules(package)))
        mixed += [(sentence, package) for sentence in draw.sample(theirs, count)]
    draw.shuffle(mixed)
    for number, (sentence, _) in enumerate(mixed, 1):
        sys.stdout.write(f"{number:3} {sentence}\n")
    for number, (_, source) in enumerate(mixed, 1):
        sys.stdout.write(f"{number:3} {source}\n")


def _pool(files: Iterable[Path]) -> list[tuple[str, Path]]:
    """The sentences of files, each with its file."""
    return sorted({
        (sentence, path)
        for path in files
        for text in (_strings(path) if path.suffix == ".py" else _paragraphs(path))
        for sentence in _sentences(text)
    })  # fmt: skip


def _whole(pool: Iterable[tuple[str, Path]]) -> list[str]:
    """The different sentences that begin with a capital, end with a period, and contain no markup or formula."""
    markup = re.compile(r">>>|::|----|:math|\\| : ")
    whole = (sentence for sentence, _ in pool if re.match(r"[A-Z`].*\.$", sentence))
    return sorted({each for each in whole if len(each) <= MAX_LENGTH and not markup.search(each)})


def _modules(package: str) -> list[Path]:
    """The files of an installed package, without its tests."""
    spec = importlib.util.find_spec(package)
    folders = [] if spec is None else spec.submodule_search_locations or []
    return [
        file for folder in folders for file in Path(folder).rglob("*.py") if "test" not in file.as_posix()
    ]


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
