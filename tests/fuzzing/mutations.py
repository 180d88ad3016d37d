"""Damage of bytes, text and trees of values; everything is drawn from the generator that is handed in."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Iterator
from random import Random
from typing import Any

NUMBERS = (
    *(0, -1, 1, 2, 1.5, -0.0, 1e-320, 1e308, -1e308, 10**12, 10**400, -(10**30), 2**31, 2**63, 2**64),
    *(math.nan, math.inf, -math.inf, 0.1, 1e-9, 1e9, 255, 300.0, -300.0),
)
TEXTS = (
    *(
        "",
        " ",
        "\0",
        "a\0b",
        "nan",
        "inf",
        "-1",
        "1e999",
        "None",
        "true",
        "../../x",
        "/",
        ".",
        "..",
        "~",
        "${HOME}",
    ),
    *(
        "${X",
        "${X:-y}",
        "/dev/zero",
        "/dev/null",
        "/proc/self/mem",
        "x" * 300,
        "y" * 100_000,
        "é",
        "\u202e",
        "\U0001f4a9",
    ),
    *(
        "sionna:",
        "sionna:../../x",
        "sionna:box",
        "%s%n",
        "{0}",
        "'",
        '"',
        "`",
        "\\",
        "\n",
        "*",
        "[",
        "iso",
        "itu:",
        "itu:wood",
    ),
    *(
        "links.csv",
        "scene.xml",
        "horn.csv",
        "study.toml",
        "loss",
        "half",
        "x",
        "walls",
        "concrete",
        "auto",
        "replay",
    ),
)
OTHERS = (True, False, [], {}, [[]], [1], ["x"], {"x": 1}, [None], list(range(50)))


def hostile(rng: Random) -> Any:
    """A value that somebody might have written."""
    return rng.choice(rng.choice((NUMBERS, NUMBERS, TEXTS, OTHERS)))


def damage(rng: Random, content: bytes) -> bytes:
    """Bytes with flipped bits, or cut, repeated, overwritten or moved pieces; never the same as before."""
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        place = rng.randrange(len(changed)) if changed else 0
        span = rng.choice((1, 2, 8, 64))
        match rng.randrange(8):
            case 0 | 1 | 2 if changed:
                changed[place] ^= 1 << rng.randrange(8)
            case 3:
                del changed[place:]
            case 4:
                del changed[place : place + span]
            case 5:
                changed[place:place] = rng.randbytes(span)
            case 6:
                changed[place : place + span] = bytes([rng.choice((0, 255, 10, 32, 48))]) * span
            case _:
                changed[place:place] = changed[place : place + span] * rng.choice((1, 2, 50))
    return bytes(changed) if bytes(changed) != content else content + b"\0"


def soup(rng: Random, words: tuple[str, ...], most: int = 12) -> str:
    """Words in any order."""
    return rng.choice(("", " ")).join(rng.choice(words) for _ in range(rng.randint(1, most)))


def places(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The ways to everything in a tree of tables and lists, but for the tree itself."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        yield (*path, key)
        yield from places(value, (*path, key))


def at(tree: Any, path: tuple[Any, ...]) -> Any:
    """What lies at the end of a way."""
    for key in path:
        tree = tree[key]
    return tree


def edited(rng: Random, tree: Any) -> tuple[Any, str, bool]:
    """A tree with one thing changed, what that was, and whether it holds something that cannot be a number."""
    changed = copy.deepcopy(tree)
    path = rng.choice(list(places(changed)))
    parent, key = at(changed, path[:-1]), path[-1]
    kind = rng.choice(("replace", "replace", "replace", "near", "remove", "rename", "add", "swap"))
    old, senseless = parent[key], False
    match kind:
        case "near" if isinstance(old, int | float) and not isinstance(old, bool) and abs(old) < 1e300:
            parent[key] = rng.choice(
                (-old, old * 1.01, old + 1, old * 1e3, old * 1e-3, str(old), [old], old == 0)
            )
        case "near" if isinstance(old, str) and old:
            parent[key] = rng.choice((old[:-1], old + "x", old.upper(), old[::-1], f" {old}", old + "\0"))
        case "remove":
            del parent[key]
        case "rename" | "add" if isinstance(parent, dict):
            parent[f"zz_{str(key)[:20]}"] = parent.pop(key) if kind == "rename" else old
        case "swap":
            other = rng.choice(list(places(tree)))
            parent[key] = copy.deepcopy(at(tree, other))
        case _:
            parent[key] = value = hostile(rng)
            senseless = isinstance(value, float) and not math.isfinite(value)
            kind = "replace"
    return changed, f"{kind} {'.'.join(map(str, path))}", senseless


def toml(tree: dict[str, Any]) -> str:
    """A tree as TOML; what TOML cannot say comes out as no TOML."""
    return "".join(
        f"{json.dumps(str(key), ensure_ascii=False)} = {_toml(value)}\n" for key, value in tree.items()
    )


def _toml(value: Any) -> str:
    match value:
        case bool():
            return str(value).lower()
        case float():
            return repr(value)
        case dict():
            return (
                "{"
                + ", ".join(
                    f"{json.dumps(str(k), ensure_ascii=False)} = {_toml(v)}" for k, v in value.items()
                )
                + "}"
            )
        case list() | tuple():
            return "[" + ", ".join(map(_toml, value)) + "]"
        case int():
            return hex(value) if abs(value) > 10**300 and value > 0 else str(value)
        case _:
            return json.dumps(value, ensure_ascii=False)
