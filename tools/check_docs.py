"""Check the documentation: linked files and headings, make targets, commands, scripts, options, and page lengths.

Usage: `python tools/check_docs.py`. It lists the faults, and exits with status 1 if there are any.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import typer

from calibray.cli.app import app

ROOT = Path(__file__).resolve().parents[1]

KINDS = ("tutorial", "guides", "reference", "explanation")
"""Folders of documentation whose pages must be short."""

PYTHON_FILES = [
    file
    for folder in ("src", "tests", "benchmarks", "examples", "tools")
    for file in (ROOT / folder).rglob("*.py")
]

LONGEST = 1500
"""Largest number of words of such a page."""

_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
# Commands start a line of code; settings such as PYTHON=python3.12 may come before the target.
_OPTIONS = re.compile(r"^(?:\$ )?(?:\.venv/bin/)?calibray ([a-z][\w-]*)((?: (?!#).*)?)$", re.MULTILINE)
_SCRIPT = re.compile(r"python ((?:benchmarks|tools|examples)/[\w/]+\.py)((?: (?!#)[^\n`]*)?)")
_COMMAND = re.compile(r"^(?:\$ )?(?:\.venv/bin/)?(make|calibray)(?: \w+=\S+)* ([a-z][\w-]*)", re.MULTILINE)


def missing_links(document: Path, text: str) -> Iterator[str]:
    """Find links to files or headings that do not exist.

    Args:
        document: The Markdown file.
        text: Its content.

    Yields:
        The target of each such link. Web addresses are not checked.
    """
    for target in _LINK.findall(_FENCE.sub("", text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, heading = target.partition("#")
        file = (document.parent / name).resolve() if name else document
        if not file.exists() or (heading and heading not in anchors(file.read_text())):
            yield target


def anchors(text: str) -> set[str]:
    """The anchors of the headings of a Markdown text.

    Args:
        text: The Markdown text.

    Returns:
        The headings in lower case without punctuation, with hyphens instead of spaces.
    """
    headings = _HEADING.findall(_FENCE.sub("", text))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def missing_commands(text: str, commands: dict[str, set[str]]) -> Iterator[str]:
    """Find commands that do not exist, in blocks of code and in inline code.

    Args:
        text: The Markdown text.
        commands: The targets of `make` and the commands of `calibray`.

    Yields:
        Each such command.
    """
    code = _FENCE.findall(text) + re.findall(r"`([^`\n]+)`", _FENCE.sub("", text))
    for snippet in code:
        for program, command in _COMMAND.findall(snippet):
            if command not in commands[program]:
                yield f"{program} {command}"


def missing_options(text: str, options: dict[str, dict[str, set[str]]]) -> Iterator[str]:
    """Find options that do not exist, in blocks of code.

    Args:
        text: The Markdown text.
        options: Options by command and subcommand; "" for the command itself.

    Yields:
        Each command with such an option.
    """
    for block in _FENCE.findall(text):
        for command, rest in _OPTIONS.findall(re.sub(r"\\\n\s*", "", block)):
            words = rest.partition(" #")[0].split()
            allowed = options.get(command, {})
            allowed_here = allowed.get(words[0] if words else "", allowed.get("", set()))
            for word in words:
                name = word.partition("=")[0]
                if re.fullmatch(r"--[a-z][\w-]*|-[a-z]", name) and name not in allowed_here:
                    yield f"calibray {command} {name}"


def missing_modules(text: str) -> Iterator[str]:
    """Find Python files that do not exist, in inline code.

    Args:
        text: The Markdown text.

    Yields:
        Each such file. A name without a folder may refer to a file in any folder.
    """
    for name in re.findall(r"`([a-z0-9_/-]+\.py)`", _FENCE.sub("", text)):
        if not any(file.as_posix().endswith("/" + name) for file in PYTHON_FILES):
            yield name


def missing_scripts(text: str) -> Iterator[str]:
    """Find scripts, and options of scripts, that do not exist.

    Args:
        text: Markdown, or the source of a module whose docstring has commands.

    Yields:
        Each such script or option. Modules that a script imports from its folder may also define its options.
    """
    for script, rest in _SCRIPT.findall(re.sub(r"\\\n\s*", "", text)):
        file = ROOT / script
        source = file.read_text(encoding="utf-8") if file.exists() else ""
        imported = re.findall(r"^from (\w+) import", source, re.MULTILINE)
        neighbours = [file.with_name(f"{name}.py") for name in imported]
        source += "".join(each.read_text(encoding="utf-8") for each in neighbours if each.exists())
        options = re.findall(r"(?<![\w-])--[a-z][\w-]*", rest.partition(" #")[0])
        if not file.exists():
            yield script
        yield from (f"{script} {name}" for name in options if f'"{name}"' not in source)


def options_of(command: Any) -> set[str]:
    """The options of a command.

    Args:
        command: The command.

    Returns:
        Every name of every option.
    """
    return {name for parameter in command.params for name in [*parameter.opts, *parameter.secondary_opts]} | {
        "--help",
        "-h",
    }


def too_long() -> list[str]:
    """Find pages with more than `LONGEST` words; measurements may be longer."""
    pages = [page for kind in KINDS for page in sorted((ROOT / "docs" / kind).rglob("*.md"))]
    words = {page.relative_to(ROOT): len(page.read_text(encoding="utf-8").split()) for page in pages}
    return [
        f"{page}: {count} words; split it below {LONGEST}" for page, count in words.items() if count > LONGEST
    ]


def faults() -> list[str]:
    """Check every Markdown file of the repository.

    Returns:
        A sentence for each fault.
    """
    targets = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    group = cast(Any, typer.main.get_command(app)).commands
    commands = {"make": set(targets[1].split()) if targets else set(), "calibray": set(group)}
    options = {
        name: {
            "": options_of(command),
            **{sub: options_of(subcommand) for sub, subcommand in getattr(command, "commands", {}).items()},
        }
        for name, command in group.items()
    }
    folders = [folder for folder in ROOT.iterdir() if folder.is_dir() and not folder.name.startswith(".")]
    documents = sorted([*ROOT.glob("*.md"), *(file for folder in folders for file in folder.rglob("*.md"))])
    sentences = too_long()
    for document in documents:
        text = document.read_text(encoding="utf-8")
        missing = [
            *missing_links(document, text),
            *missing_modules(text),
            *missing_commands(text, commands),
            *missing_options(text, options),
            *missing_scripts(text),
        ]
        sentences += [f"{document.relative_to(ROOT)}: {name} does not exist" for name in missing]
    for file in PYTHON_FILES:
        missing = missing_scripts(file.read_text(encoding="utf-8"))
        sentences += [f"{file.relative_to(ROOT)}: {name} does not exist" for name in missing]
    return sentences


if __name__ == "__main__":
    errors = faults()
    sys.stdout.write("\n".join([*errors, f"{len(errors)} faults"]) + "\n")
    sys.exit(bool(errors))
