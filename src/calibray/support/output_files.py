"""Output files, which are checked before any computation starts and are written either completely or not at all.

An output never replaces an input, a link or a device. By default, an output also never replaces a file that Calibray
did not write, or one that has changed since Calibray wrote it. Calibray signs its files: the file `.calibray` in the
same folder lists the digest and the name of each file.

`replacing` creates each file under a random name in the same folder, without following links. When the file is
complete, it is moved into place in a single step.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import os
import re
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NoReturn

from calibray.errors import InputError
from calibray.support.messages import shortened, type_name

PARTIAL: Final = ".part"  # suffix of unfinished files
SIGNATURES: Final = ".calibray"  # one line per written file: SHA-256 and name; lines are only appended
SIGNATURES_LIMIT: Final = 2**26  # maximum size of a signature file [bytes]; a line takes about 80 bytes
PATH_SEAL: Final = b"calibray/paths sha256 "  # start of a path file
STALE_SECONDS: Final = 60.0  # age at which an unfinished file is removed if its process has ended

_UNFINISHED: Final = re.compile(r"\.([0-9]{1,10})-[0-9a-f]{32}" + re.escape(PARTIAL))  # with the process id
_SIGNATURE_LINE: Final = re.compile(rb"[0-9a-f]{64}  ")  # start of each line of a signature file
# Windows lacks the first two flags, but there links require special privileges, and folders contain no FIFOs.
NO_LINK: Final = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)


def as_path(name: object, role: str) -> Path:
    """Convert a caller's name of a file or folder to a path; error messages start with `role`.

    Raises:
        InputError: The name is neither text nor a path.
    """
    if not isinstance(name, str | os.PathLike) or isinstance(os.fspath(name), bytes):
        raise InputError(
            f"{role}: is a {type_name(name)}; it must be the name of a file or folder, as text or Path"
        )
    return Path(name)


def exists(file: str | Path) -> bool:
    """Whether a file exists; links are followed. The result is False for folders, devices and invalid names."""
    try:
        return Path(file).is_file()
    except (OSError, ValueError):
        return False


# The checks below run before the computation and create nothing.


def check_folder(folder: str | Path) -> Path:
    """Refuse a folder in which no file can be created; the folder need not exist.

    Raises:
        InputError: The folder, or the folder in which it would be created, is a file or cannot be written to.
    """
    target = _valid_name(folder, "output folder")
    nearest = next(path for path in (target, *target.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise InputError(f"output folder {target}: {nearest} is a file; name another folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"output folder {target}: {nearest} cannot be written to; choose another folder")
    return target


def check_outputs(
    folder: str | Path, names: Sequence[str], inputs: Iterable[Path] = (), overwrite: bool = False
) -> Path:
    """Refuse a folder in which no file can be created, or in which an output would replace a file that must be kept.

    `inputs` are the files that the computation reads, which are never replaced. With `overwrite`, files that Calibray
    did not write are replaced.

    Raises:
        InputError: A check of `check_folder` or `check_replaceable` fails, or the folder's file `.calibray` was not
            written by Calibray.
    """
    target, sources = check_folder(folder), list(inputs)
    _check_signature_file(target)
    for name in names:
        check_replaceable(target / name, sources, overwrite)
    return target


def check_file(file: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False) -> Path:
    """Refuse a file that cannot be written; the file need not exist, but its folder must. See also `check_outputs`.

    Raises:
        InputError: The file is a folder, its parent folder does not exist or cannot be written to, or a check of
            `check_outputs` fails.
    """
    target = _valid_name(file, "output file")
    if target.is_dir():
        raise InputError(f"output file {target}: is a folder; name a file in this folder")
    if not target.parent.is_dir():
        raise InputError(
            f"output file {target}: there is no folder {target.parent}; create it, or choose another folder"
        )
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise InputError(f"output file {target}: {target.parent} cannot be written to; choose another folder")
    _check_signature_file(target.parent)
    check_replaceable(target, inputs, overwrite)
    return target


def check_replaceable(file: Path, inputs: Iterable[Path] = (), overwrite: bool = False) -> None:
    """Refuse an output that would replace a file that must be kept; an output that does not exist yet is accepted.

    Raises:
        InputError: The file is an input, a link, a device or a folder; or `overwrite` is False, and the file was not
            written by Calibray or was changed later.
    """
    status = _status(file, "output file")
    if status is None:
        return
    if stat.S_ISLNK(status.st_mode):
        raise InputError(
            f"output file {file}: is a symbolic link; give the file that the link points to, or another file"
        )
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"output file {file}: is a folder, a device or a FIFO; give a file")
    for source in inputs:
        if source.exists() and file.samefile(source):
            raise InputError(f"output file {file}: is an input; name another file")
    if status.st_size and not overwrite and not is_unchanged_output(file):
        raise InputError(
            f"output file {file}: was not written by Calibray, or has changed since then; name another file, move this "
            "file away, or give --overwrite"
        )


def check_unchanged(file: Path) -> None:
    """Refuse a file that has changed since Calibray signed it; unsigned files are accepted.

    Raises:
        InputError: The file has changed since it was written.
    """
    signatures = [line for line in _signatures(file.parent) if line.partition("  ")[2] == file.name]
    if signatures and _signature(file, file.name) not in signatures:
        raise InputError(
            f"{file}: has changed since Calibray wrote it, so its values may be wrong; run the study again, or "
            "give --allow-changed-inputs (allow_changed_inputs=True)"
        )


def is_unchanged_output(file: Path) -> bool:
    """Whether a file is unchanged since Calibray signed it; always True for path files, which have their own seal."""
    if _signature(file, file.name) in _signatures(file.parent):
        return True
    with file.open("rb") as stream:
        return stream.read(len(PATH_SEAL)) == PATH_SEAL


def _valid_name(path: str | Path, role: str) -> Path:
    """Convert the name of an output to a path, and refuse an invalid name."""
    target = as_path(path, role)
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
        raise InputError(f"{name}: cannot be accessed ({error.strerror}); choose another name") from None
    except ValueError as error:
        raise InputError(f"{name}: is not a valid name ({error}); choose another name") from None


def _signatures(folder: Path) -> list[str]:
    """The lines of a folder's signature file; empty if there is no such file or Calibray did not write it."""
    try:
        with _open_signatures(folder, os.O_RDONLY) as stream:
            return stream.read().decode("utf-8", errors="replace").splitlines()
    except (OSError, InputError):
        return []


def _check_signature_file(folder: Path) -> None:
    """Refuse a folder whose signature file was not written by Calibray, because files in it could not be signed."""
    # If the signature file cannot be read, writing to it fails later, with the same message as for any other file.
    with suppress(OSError), _open_signatures(folder, os.O_RDONLY):
        pass


def _open_signatures(folder: Path, flags: int) -> BinaryIO:
    """Open the signature file of a folder with the given flags of `os.open`.

    Raises:
        InputError: The file is a link, a folder or a device, belongs to another user, is too large, or was written by
            another program.
        OSError: The file does not exist or cannot be opened.
    """
    path = folder / SIGNATURES
    # Opening a FIFO or a device may block or have side effects, so the status is checked before and after the file is
    # opened.
    with suppress(FileNotFoundError):
        _check_signature_status(path, path.lstat())
    stream = os.fdopen(
        os.open(path, flags | NO_LINK, 0o666), "rb" if flags == os.O_RDONLY else "r+b", buffering=0
    )
    try:
        _check_signature_status(path, os.fstat(stream.fileno()))
        head = stream.read(66)
        if head and not _SIGNATURE_LINE.match(head):
            _refuse_signature_file(path, "another program wrote it")
        stream.seek(0)
    except BaseException:
        stream.close()
        raise
    return stream


def _check_signature_status(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        _refuse_signature_file(path, "the file is a link, a folder, a device or a FIFO")
    if hasattr(os, "geteuid") and status.st_uid != os.geteuid():
        _refuse_signature_file(path, "the file belongs to another user")
    if status.st_size > SIGNATURES_LIMIT:
        _refuse_signature_file(path, f"the file has more than {SIGNATURES_LIMIT} bytes")


def _refuse_signature_file(path: Path, fault: str) -> NoReturn:
    raise InputError(
        f"{path}: Calibray keeps the digests of its files under this name, but {fault}; move it away, or name another "
        "folder"
    )


def _signature(file: Path, name: str) -> str:
    """The signature line of a file; unprintable characters in its name are escaped."""
    return f"{file_digest(file)}  {name if name.isprintable() else ascii(name)}"


def file_digest(file: Path) -> str:
    """The SHA-256 digest of a file's content."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# Writing


HDF5_METADATA: Final = 2**16  # generous size of an HDF5 file without its datasets [bytes]


def check_space(partial: Path, size: int) -> None:
    """Raise an error if an HDF5 file whose datasets have the given total size [bytes] would not fit on its disk.

    On a full disk, the HDF5 library prints errors that cannot be caught, and may crash the process when it exits.

    Raises:
        OSError: The disk has too little free space.
    """
    if shutil.disk_usage(partial.parent).free < size + HDF5_METADATA:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(partial))


@contextmanager
def replacing(path: Path, signed: bool = True) -> Iterator[Path]:
    """Write a file under a temporary name; when it is complete, it is signed and moved into place.

    Files with their own seal need not be signed. Yields an empty temporary file in the same folder; this file is
    removed if writing fails.

    Raises:
        InputError: The file is a link, a device or a folder; `.calibray` was not written by Calibray; or another
            program replaced the temporary file.
    """
    check_replaceable(
        path, overwrite=True
    )  # whether a regular file may be replaced was checked before the computation
    _remove_unfinished(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}-{uuid.uuid4().hex}{PARTIAL}")
    descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | NO_LINK, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as created:
            yield partial
            # Another user with write access to the folder could have put a link or another file under this name. The
            # created file stays open until here, so that no other file can get its inode number.
            if not os.path.samestat(partial.lstat(), os.fstat(created.fileno())):
                raise InputError(
                    f"output file {path}: another program replaced {partial}; choose another folder"
                )
        if signed:
            # The file is signed first, so that the next run recognizes it even if the process is killed between the two
            # steps.
            _sign(partial, path)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _sign(partial: Path, path: Path) -> None:
    """Add the signature line of a file to the folder's signature file."""
    signature = _signature(partial, path.name)
    # The search is skipped for a new file, because it is rarely signed already and a repeated line does no harm.
    if path.exists() and signature in _signatures(path.parent):
        return
    with _open_signatures(path.parent, os.O_RDWR | os.O_CREAT | os.O_APPEND) as stream:
        stream.write(f"{signature}\n".encode())


def _remove_unfinished(path: Path) -> None:
    """Remove the unfinished files of processes that were killed while writing this file."""
    final = path.name
    # A scene's folder may contain thousands of files, and creating a Path for each of them would take long.
    with os.scandir(path.parent) as entries:
        unfinished = [
            (path.with_name(entry.name), match)
            for entry in entries
            if entry.name.startswith(final)
            and (match := _UNFINISHED.fullmatch(entry.name.removeprefix(final)))
        ]
    for partial, match in unfinished:
        try:
            status = partial.lstat()
            if stat.S_ISREG(status.st_mode) and time.time() - status.st_mtime > STALE_SECONDS:
                os.kill(int(match[1]), 0)  # raises ProcessLookupError if the process has ended
        except ProcessLookupError:
            partial.unlink(missing_ok=True)
        except (OSError, OverflowError):
            continue


def write_text(path: Path, text: str) -> None:
    """Write a text file and move it into place when it is complete."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file and move it into place when it is complete."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def append_text(path: Path, text: str) -> None:
    """Append to a text file of finished results, creating it if it does not exist.

    Raises:
        InputError: The file is a link, a device or a folder.
    """
    check_replaceable(path, overwrite=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | NO_LINK, 0o666), "ab") as stream:
        stream.write(text.encode("utf-8"))


if TYPE_CHECKING:
    import pandas as pd

TABLES: Final = (".csv", ".parquet")

# Matches texts that a spreadsheet would evaluate as a formula, or that are already marked with an apostrophe.
_FORMULA: Final = re.compile("'*[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20].", re.DOTALL)


def check_table(file: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False) -> Path:
    """Refuse a table that cannot be written (see `check_file`); the name must end in .csv or .parquet.

    Raises:
        InputError: The name has another extension, or a check of `check_file` fails.
    """
    target = check_file(file, inputs, overwrite)
    if target.suffix.lower() not in TABLES:
        raise InputError(
            f"output file {target}: the name of a table must end in {' or '.join(TABLES)}; rename the file"
        )
    return target


def write_table(path: str | Path, table: pd.DataFrame) -> None:
    """Write a CSV or Parquet file without the index and move it into place; see `growing_table` for the errors."""
    with growing_table(path) as append:
        append(table)


def csv_text(table: pd.DataFrame, float_format: str | None = None, header: bool = True) -> str:
    """Format a table as CSV without its index; texts that a spreadsheet would evaluate start with an apostrophe."""
    names = [formula_free(name) for name in table.columns]
    safe, returns = table.set_axis(names, axis=1), any("\r" in str(name) for name in names)
    for number, kind in enumerate(table.dtypes):  # by position, since names may repeat
        if kind.kind not in "biufcmM":
            cells = table.iloc[:, number].astype(object).map(formula_free, na_action="ignore")
            returns = returns or any(isinstance(cell, str) and "\r" in cell for cell in cells)
            safe.isetitem(number, cells.to_numpy())
    return safe.to_csv(
        index=False,
        header=header,
        float_format=float_format,
        lineterminator="\n",
        # Python's writer does not quote carriage returns, which readers would interpret as the end of a line.
        quoting=csv.QUOTE_NONNUMERIC if returns else csv.QUOTE_MINIMAL,
    )


def formula_free(cell: Any) -> Any:
    """Put an apostrophe before text that a spreadsheet would read as a formula; other values are unchanged.

    Example:
        >>> formula_free("=HYPERLINK(1)"), formula_free("-80.5"), formula_free("- east")
        ("'=HYPERLINK(1)", '-80.5', "'- east")
    """
    if not (isinstance(cell, str) and _FORMULA.match(cell)):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def without_formula_mark(cell: str) -> str:
    """Remove the apostrophe that `formula_free` adds."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


@contextmanager
def growing_table(path: str | Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    """Write a CSV or Parquet file in parts, and move it into place when it is complete.

    Yields a function that appends the rows of a table, without their index; all tables must have the same columns and
    types as the first.

    Raises:
        InputError: A check of `check_table` fails, the type of a column changes, or pyarrow, which Parquet needs, is
            missing.
    """
    # A check before the computation has ensured that the file may be replaced.
    target = check_table(path, overwrite=True)
    write = _csv if target.suffix.lower() == ".csv" else _parquet
    with replacing(target) as partial, write(partial, target) as append:
        yield append


@contextmanager
def _csv(partial: Path, _: Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    with partial.open("w", encoding="utf-8") as stream:

        def append(table: pd.DataFrame) -> None:
            stream.write(csv_text(table, header=stream.tell() == 0))

        yield append


@contextmanager
def _parquet(partial: Path, target: Path) -> Iterator[Callable[[pd.DataFrame], None]]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise InputError(
            f"{target}: Parquet needs pyarrow; install it with: pip install 'calibray[parquet]'"
        ) from None
    with ExitStack() as stack:
        writers: list[parquet.ParquetWriter] = []

        def append(table: pd.DataFrame) -> None:
            schema = writers[0].schema if writers else None
            try:
                rows = pyarrow.Table.from_pandas(table, schema, preserve_index=False)
            except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError) as error:
                raise InputError(f"{target}: cannot be written as Parquet ({error}); write CSV") from None
            if not writers:
                writers.append(stack.enter_context(parquet.ParquetWriter(partial, rows.schema)))
            writers[0].write_table(rows)

        yield append
