"""OBJ meshes, checked before a ray tracer sees them: it takes vertices that are no numbers, and traces nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibray.errors import InputError
from calibray.support.messages import shortened


def check_obj(path: Path) -> None:
    """Refuse an OBJ mesh with a vertex that is not finite, or a face that names none of its vertices.

    Args:
        path: The file.

    Raises:
        InputError: The mesh cannot be read, has no faces, or has such a vertex or face.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"mesh {path}: cannot be read ({error.strerror}); check the file") from None
    vertices = faces = 0
    for number, line in enumerate(text.splitlines(), start=1):
        words, rule = line.split(), ""
        if words[:1] == ["v"]:
            vertices += 1
            if len(words) < 4 or not np.isfinite([_number(word) for word in words[1:4]]).all():
                rule = "a vertex is three finite numbers"
        elif words[:1] == ["f"]:
            faces += 1
            corners = [_number(word.partition("/")[0]) for word in words[1:]]
            # Counted from 1, or from the last one backwards.
            known = all(1 <= abs(each) <= vertices and each == round(each) for each in corners)
            if len(corners) < 3 or not known:
                rule = f"a face names three or more of the {vertices} vertices before it"
        if rule:
            raise InputError(
                f"mesh {path}, line {number}: {shortened(line.strip())!r}: {rule}; export it again"
            )
    if not faces:
        raise InputError(f"mesh {path}: has no faces; export it again")


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return float("nan")
