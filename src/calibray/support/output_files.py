"""Output files: refused before the work if they could not be written, and never half-written.

An output never replaces an input, a link or a device, nor a file that Calibray did not write or that was changed since.
Calibray signs the files that it writes: `.calibray` in the same folder lists the digest and the name of each.
"""

from __future__ import annotations

import glob
import hashlib
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
PARTIAL: Final = ".part"  # end of the name of an unfinished file
SIGNATURES: Final = ".calibray"  # a line per file written, its SHA-256 and its name; only appended to
PATH_SEAL: Final = b"calibray/paths sha256 "  # start of a path file
STALE_SECONDS: Final = 60.0  # age at which an unfinished file is removed if its process has ended


def exists(file: str | Path) -> bool:
    """Whether a file exists, also through a link. Folders, devices and invalid names give False."""
    try:
        return Path(file).is_file()
    except (OSError, ValueError):
        return False


# Checks before the work; nothing is created yet.


def check_folder(folder: str | Path) -> Path:
    """Refuse a folder that no file can be written into.

    Args:
        folder: The folder, which need not exist.

    Returns:
        Its path.

    Raises:
        InputError: The folder, or the one that it would be created in, is a file or cannot be written.
    """
    target = _valid_name(folder, "output folder")
    nearest = next(path for path in (target, *target.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise InputError(f"output folder {target}: {nearest} is a file; name another folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"output folder {target}: {nearest} cannot be written; name another folder")
    return target


def check_outputs(
    folder: str | Path, names: Sequence[str], inputs: Iterable[Path] = (), overwrite: bool = False
) -> Path:
    """Refuse a folder that files cannot be written into, or with files that must not be replaced.

    Args:
        folder: The folder, which need not exist.
        names: The files that will be written there.
        inputs: Files that the work reads; none of them is ever replaced.
        overwrite: Replace files that Calibray did not write.

    Returns:
        The folder's path.

    Raises:
        InputError: As for `check_folder` and `check_replaceable`.
    """
    target, sources = check_folder(folder), list(inputs)
    for name in names:
        check_replaceable(target / name, sources, overwrite)
    return target


def check_file(file: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False) -> Path:
    """Refuse a file that cannot be written.

    Args:
        file: The file, which need not exist; its folder must.
        inputs: Files that the work reads; none of them is ever replaced.
        overwrite: Replace a file that Calibray did not write.

    Returns:
        Its path.

    Raises:
        InputError: It is a folder, its folder does not exist or cannot be written, or as for `check_replaceable`.
    """
    target = _valid_name(file, "output file")
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
    """Refuse a table that cannot be written: as `check_file`, and the name must end in .csv or .parquet.

    Raises:
        InputError: The ending is another one, or as for `check_file`.
    """
    target = check_file(file, inputs, overwrite)
    if target.suffix.lower() not in TABLES:
        raise InputError(f"output file {target}: tables end in {' or '.join(TABLES)}; name it so")
    return target


def check_replaceable(file: Path, inputs: Iterable[Path] = (), overwrite: bool = False) -> None:
    """Refuse to replace a file that must be kept; a file that does not exist may be written.

    Args:
        file: The output.
        inputs: Files that the work reads; none of them is ever replaced.
        overwrite: Replace a file that Calibray did not write.

    Raises:
        InputError: It is an input, a link, a device or a folder; or a file that Calibray did not write, or that was
            changed since, unless `overwrite`.
    """
    status = _status(file, "output file")
    if status is None:
        return
    if stat.S_ISLNK(status.st_mode):
        raise InputError(f"output file {file}: is a link; name the file that it leads to, or another")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"output file {file}: is a folder, a device or a FIFO; name a file")
    for source in inputs:
        if source.exists() and file.samefile(source):
            raise InputError(f"output file {file}: is an input of the study; name another")
    if status.st_size and not overwrite and not is_unchanged_output(file):
        raise InputError(
            f"output file {file}: was not written by Calibray, or was changed since; name another, move it away, or "
            "give --overwrite"
        )


def check_unchanged(file: Path) -> None:
    """Refuse a file that Calibray signed and that was changed since; an unsigned file may have any content.

    Args:
        file: The file, which can be read.

    Raises:
        InputError: The file changed since it was written.
    """
    signatures = [line for line in _signatures(file.parent) if line.partition("  ")[2] == file.name]
    if signatures and _signature(file, file.name) not in signatures:
        raise InputError(
            f"{file}: changed since Calibray wrote it, so its numbers may be wrong; run the study again, or "
            "give --allow-changed-inputs (allow_changed_inputs=True)"
        )


def is_unchanged_output(file: Path) -> bool:
    """Whether Calibray wrote a file in its present form: it is signed, or it is a path file, which has its own seal."""
    if _signature(file, file.name) in _signatures(file.parent):
        return True
    with file.open("rb") as stream:
        return stream.read(len(PATH_SEAL)) == PATH_SEAL


def _valid_name(path: str | Path, role: str) -> Path:
    """The path of an output; refused if no file can have the name."""
    target = Path(path)
    _status(target, role)
    return target


def _status(path: Path, role: str) -> os.stat_result | None:
    """The status of an output; None if it does not exist."""
    name = f"{role} {shortened(str(path), 300)}"
    try:
        return path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise InputError(f"{name}: cannot be looked up ({error.strerror}); name another") from None
    except ValueError as error:
        raise InputError(f"{name}: cannot be a name ({error}); name another") from None


def _signatures(folder: Path) -> list[str]:
    try:
        return (folder / SIGNATURES).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _signature(file: Path, name: str) -> str:
    with file.open("rb") as stream:
        return f"{hashlib.file_digest(stream, 'sha256').hexdigest()}  {name}"


# Writing


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a file under a temporary name; it is signed and moved into place once it is complete.

    Args:
        path: The file.

    Yields:
        The temporary file in the same folder, removed if writing fails.
    """
    _remove_unfinished(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}-{uuid.uuid4().hex[:8]}{PARTIAL}")
    try:
        yield partial
        # Signed first: after a kill between the two steps, the next run must still recognise the file as its own.
        signature = _signature(partial, path.name)
        if signature not in _signatures(path.parent):
            with (path.parent / SIGNATURES).open("a", encoding="utf-8") as stream:
                stream.write(f"{signature}\n")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _remove_unfinished(path: Path) -> None:
    """Remove the unfinished files of processes that were killed while they wrote this file."""
    for partial in path.parent.glob(f"{glob.escape(path.name)}.*-*{PARTIAL}"):
        process = partial.name.removeprefix(f"{path.name}.").split("-")[0]
        try:
            if process.isdigit() and time.time() - partial.lstat().st_mtime > STALE_SECONDS:
                os.kill(int(process), 0)  # raises ProcessLookupError if it has ended
        except ProcessLookupError:
            partial.unlink(missing_ok=True)
        except (OSError, OverflowError):
            continue


def write_text(path: Path, text: str) -> None:
    """Write a text file and move it into place once it is complete."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_table(path: str | Path, table: pd.DataFrame) -> None:
    """Write a CSV or Parquet file, without the index, and move it into place; errors as for `growing_table`."""
    with growing_table(path) as append:
        append(table)


@contextmanager
def growing_table(path: str | Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    """Write a CSV or Parquet file in parts and move it into place once it is complete.

    Args:
        path: The file; its ending decides the format.

    Yields:
        A function that appends rows without their index; all calls must give the columns and types of the first one.

    Raises:
        InputError: As for `check_table`, or Parquet without pyarrow, or a column changes its type.
    """
    # Whether the file may be replaced was checked before the work.
    target = check_table(path, overwrite=True)
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
