"""Output files: refused before the work if they could not be written, and never half-written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pandas as pd

from calibray.errors import InputError

TABLES: Final = (".csv", ".parquet")
PARTIAL: Final = ".part"  # what the name of an unfinished file ends with


def exists(file: str | Path) -> bool:
    """Whether there is a file of a name; none has a name that no file can have.

    Args:
        file: The file.

    Returns:
        True for a file, also through a link; False for a folder, a device or nothing.
    """
    try:
        return Path(file).is_file()
    except (OSError, ValueError):
        return False


def check_folder(folder: str | Path) -> Path:
    """Refuse a folder that no file can be written into; nothing is made yet.

    Args:
        folder: The folder, which need not exist.

    Returns:
        Its path.

    Raises:
        InputError: It, or what it would be made in, is a file or cannot be written.
    """
    target = Path(folder)
    nearest = next(path for path in (target, *target.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise InputError(f"output folder {target}: {nearest} is a file; name another folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"output folder {target}: {nearest} cannot be written; name another folder")
    return target


def check_file(file: str | Path) -> Path:
    """Refuse a file that cannot be written; nothing is made yet.

    Args:
        file: The file, which need not exist; its folder must.

    Returns:
        Its path.

    Raises:
        InputError: It is a folder, or its folder does not exist or cannot be written.
    """
    target = Path(file)
    if target.is_dir():
        raise InputError(f"output file {target}: is a folder; name a file in it")
    if not target.parent.is_dir():
        raise InputError(
            f"output file {target}: there is no folder {target.parent}; make it, or name another"
        )
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise InputError(f"output file {target}: {target.parent} cannot be written; name another")
    return target


def check_table(file: str | Path) -> Path:
    """Refuse a table that cannot be written; nothing is made yet.

    Args:
        file: The file; its ending says how it will be written.

    Returns:
        Its path.

    Raises:
        InputError: The ending is another, or what `check_file` refuses.
    """
    target = check_file(file)
    if target.suffix.lower() not in TABLES:
        raise InputError(f"output file {target}: tables end in {' or '.join(TABLES)}; name it so")
    return target


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A place beside a file to write the new one into; it takes the file's place once it is complete.

    Args:
        path: The file.

    Yields:
        Where to write; removed again if the writing fails.
    """
    partial = path.with_name(path.name + PARTIAL)
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file beside its place and move it there.

    Args:
        path: The file.
        text: Its content.
    """
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_table(path: str | Path, table: pd.DataFrame) -> None:
    """Write a CSV or Parquet file beside its place and move it there.

    Args:
        path: The file; its ending says how it is written.
        table: The rows; their index is left out.

    Raises:
        InputError: What `check_table` refuses, or it is Parquet and pyarrow is not installed.
    """
    target = check_table(path)
    if target.suffix.lower() == ".csv":
        write_text(target, table.to_csv(index=False))
        return
    with replacing(target) as partial:
        try:
            table.to_parquet(partial, index=False)
        except ImportError:
            raise InputError(
                f"{target}: Parquet needs pyarrow; install it with: pip install calibray[parquet]"
            ) from None
