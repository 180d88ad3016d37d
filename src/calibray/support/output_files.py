"""Output files: refused before the work if they could not be written, and never half-written.

An output never takes the place of an input, of a link or a device, nor of a file that Calibray did not write or that
was changed since. What it writes it signs: the digest and the name of each file stand in `.calibray` beside it.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import stat
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from calibray.errors import InputError
from calibray.support.messages import shortened

if TYPE_CHECKING:
    import pandas as pd

TABLES: Final = (".csv", ".parquet")
PARTIAL: Final = ".part"  # what the name of an unfinished file ends with
SIGNATURES: Final = ".calibray"  # one line a file written, its SHA-256 and its name; only ever appended to
FIRST_RESULT: Final = (
    "result.json",
    "links.csv",
    "history.csv",
    "scene.xml",
)  # of the first version, not signed
PATH_SEAL: Final = b"calibray/paths sha256 "  # what a path file begins with
STALE: Final = 60.0  # age of an unfinished file whose process is gone [s]


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
    target = _named(folder, "output folder")
    nearest = next(path for path in (target, *target.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise InputError(f"output folder {target}: {nearest} is a file; name another folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"output folder {target}: {nearest} cannot be written; name another folder")
    return target


def _named(path: str | Path, role: str) -> Path:
    """The path of an output, whose name some file could have."""
    target = Path(path)
    place = f"{role} {shortened(str(target), 300)}"
    try:
        target.lstat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise InputError(f"{place}: cannot be looked up ({error.strerror}); name another") from None
    except ValueError as error:
        raise InputError(f"{place}: cannot be a name ({error}); name another") from None
    return target


def check_outputs(
    folder: str | Path, names: Sequence[str], inputs: Iterable[Path] = (), overwrite: bool = False
) -> Path:
    """Refuse a folder that files cannot be written into, or that holds files in their place; nothing is made yet.

    Args:
        folder: The folder, which need not exist.
        names: The files that will be written there.
        inputs: Files that the work reads; none of them is ever replaced.
        overwrite: Replace files that Calibray did not write.

    Returns:
        The folder's path.

    Raises:
        InputError: What `check_folder` refuses, or a file there must not be replaced.
    """
    target, sources = check_folder(folder), list(inputs)
    for name in names:
        check_replaceable(target / name, sources, overwrite)
    return target


def check_replaceable(file: Path, inputs: Iterable[Path] = (), overwrite: bool = False) -> None:
    """Refuse to replace what must not be replaced; what does not exist may be written.

    Args:
        file: The output.
        inputs: Files that the work reads; none of them is ever replaced.
        overwrite: Replace a file that Calibray did not write.

    Raises:
        InputError: It is an input, a link, a device or a folder; or a file that Calibray did not write, or that was
            changed since, unless `overwrite`.
    """
    try:
        status = file.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise InputError(
            f"output file {file}: cannot be looked up ({error.strerror}); name another"
        ) from None
    if stat.S_ISLNK(status.st_mode):
        raise InputError(f"output file {file}: is a link; name the file that it leads to, or another")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"output file {file}: is a folder, a device or a FIFO; name a file")
    for source in inputs:
        if source.exists() and file.samefile(source):
            raise InputError(f"output file {file}: is an input of the study; name another")
    if status.st_size and not overwrite and not is_own(file):
        raise InputError(
            f"output file {file}: was not written by Calibray, or was changed since; name another, move it away, or "
            "give --overwrite"
        )


def is_own(file: Path) -> bool:
    """Whether Calibray wrote a file as it is.

    Args:
        file: The file.

    Returns:
        Whether it is signed; or a path file, which says so itself; or a file of a result of the first version, which
        signed nothing.
    """
    lines = _signatures(file.parent)
    if _signature(file, file.name) in lines or _is_path_file(file):
        return True
    if not lines:
        return file.name in FIRST_RESULT and _is_result(file.parent / FIRST_RESULT[0])
    return False


def check_unchanged(file: Path) -> None:
    """Refuse a file that Calibray signed and that is another now; one that nobody signed may be what it is.

    Args:
        file: The file, which can be read.

    Raises:
        InputError: The file changed since it was written.
    """
    signed = [line for line in _signatures(file.parent) if line.partition("  ")[2] == file.name]
    if signed and _signature(file, file.name) not in signed:
        raise InputError(
            f"{file}: changed since Calibray wrote it, and may say what was never found; run the study again, or "
            "give --anyway (anyway=True)"
        )


def _signatures(folder: Path) -> list[str]:
    try:
        return (folder / SIGNATURES).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _sign(folder: Path, signature: str) -> None:
    if signature not in _signatures(folder):
        with (folder / SIGNATURES).open("a", encoding="utf-8") as stream:
            stream.write(f"{signature}\n")


def _is_path_file(file: Path) -> bool:
    """Whether a file carries the seal of path files (see `calibray.paths.checksum`); nothing of it is interpreted."""
    with file.open("rb") as stream:
        return stream.read(len(PATH_SEAL)) == PATH_SEAL


def _is_result(file: Path) -> bool:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and {"version", "study", "rmse_db", "rt_calls"} <= set(content)


def _signature(file: Path, name: str) -> str:
    with file.open("rb") as stream:
        return f"{hashlib.file_digest(stream, 'sha256').hexdigest()}  {name}"


def check_file(file: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False) -> Path:
    """Refuse a file that cannot be written; nothing is made yet.

    Args:
        file: The file, which need not exist; its folder must.
        inputs: Files that the work reads; none of them is ever replaced.
        overwrite: Replace a file that Calibray did not write.

    Returns:
        Its path.

    Raises:
        InputError: It is a folder, its folder does not exist or cannot be written, or what `check_replaceable` refuses.
    """
    target = _named(file, "output file")
    if target.is_dir():
        raise InputError(f"output file {target}: is a folder; name a file in it")
    if not target.parent.is_dir():
        raise InputError(
            f"output file {target}: there is no folder {target.parent}; make it, or name another"
        )
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise InputError(f"output file {target}: {target.parent} cannot be written; name another")
    check_replaceable(target, inputs, overwrite)
    return target


def check_table(file: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False) -> Path:
    """Refuse a table that cannot be written; nothing is made yet.

    Args:
        file: The file; its ending says how it will be written.
        inputs: Files that the work reads; none of them is ever replaced.
        overwrite: Replace a file that Calibray did not write.

    Returns:
        Its path.

    Raises:
        InputError: The ending is another, or what `check_file` refuses.
    """
    target = check_file(file, inputs, overwrite)
    if target.suffix.lower() not in TABLES:
        raise InputError(f"output file {target}: tables end in {' or '.join(TABLES)}; name it so")
    return target


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A place beside a file to write the new one into; it is signed and takes the file's place once it is complete.

    Args:
        path: The file.

    Yields:
        Where to write; removed again if the writing fails.
    """
    _sweep(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}-{uuid.uuid4().hex[:8]}{PARTIAL}")
    try:
        yield partial
        # Signed first: a run that is killed in between must not find a file that it does not take for its own.
        _sign(path.parent, _signature(partial, path.name))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _sweep(path: Path) -> None:
    """Remove unfinished files of runs that were killed while they wrote this one."""
    for partial in path.parent.glob(f"{glob.escape(path.name)}.*-*{PARTIAL}"):
        number = partial.name.removeprefix(f"{path.name}.").split("-")[0]
        try:
            if number.isdigit() and time.time() - partial.lstat().st_mtime > STALE:
                os.kill(int(number), 0)
        except ProcessLookupError:
            partial.unlink(missing_ok=True)
        except (OSError, OverflowError):
            continue


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
    with growing_table(path) as append:
        append(table)


@contextmanager
def growing_table(path: str | Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    """Write a CSV or Parquet file in pieces beside its place, and move it there once it is complete.

    Args:
        path: The file; its ending says how it is written.

    Yields:
        What appends rows, with the columns of those before; their index is left out. Columns have the types of the
        first rows.

    Raises:
        InputError: What `check_table` refuses, it is Parquet and pyarrow is not installed, or a column cannot have the
            type that it had before.
    """
    target = check_table(path, overwrite=True)  # whether it may be replaced was asked before the work
    write = _csv if target.suffix.lower() == ".csv" else _parquet
    with replacing(target) as partial, write(partial, target) as append:
        yield append


@contextmanager
def _csv(partial: Path, _: Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    with partial.open("w", encoding="utf-8") as stream:
        yield lambda table: table.to_csv(stream, index=False, header=stream.tell() == 0, lineterminator="\n")


@contextmanager
def _parquet(partial: Path, target: Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise InputError(
            f"{target}: Parquet needs pyarrow; install it with: pip install calibray[parquet]"
        ) from None
    with ExitStack() as stack:
        writers: list[parquet.ParquetWriter] = []

        def append(table: pd.DataFrame) -> None:
            schema = writers[0].schema if writers else None
            try:
                rows = pyarrow.Table.from_pandas(table, schema, preserve_index=False)
            except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError) as error:
                raise InputError(f"{target}: cannot be Parquet ({error}); write CSV") from None
            if not writers:
                writers.append(stack.enter_context(parquet.ParquetWriter(partial, rows.schema)))
            writers[0].write_table(rows)

        yield append
