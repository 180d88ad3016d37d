"""The seal of a path file: a checksum at its start that is compared before anything else is read.

HDF5 allows a user block in front of the file's content. It holds the SHA-256 of the content in one line of text. A
damaged file can hang or crash the HDF5 library (among 3,000 files with flipped bits, one did each), so the library
reads a file only if the checksum is right.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import BinaryIO, Final

from calibray.errors import InputError
from calibray.support.output_files import PATH_SEAL, replacing

BLOCK: Final = 512
"""Size of the user block [bytes], the smallest that HDF5 allows."""

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
_CHUNK: Final = 2**20


def seal(path: str | Path) -> None:
    """Write or renew the checksum of a path file that another program has written or changed.

    `Paths.save` seals its files itself.

    Args:
        path: The file.

    Raises:
        InputError: The file does not exist, is not an HDF5 file, or cannot be written.
    """
    target = Path(path)
    try:
        with target.open("rb") as file:
            head = file.read(BLOCK)
            start = BLOCK if head.startswith(PATH_SEAL) or not any(head) else 0
            file.seek(start)
            if not file.read(len(_SIGNATURE)) == _SIGNATURE:
                raise InputError(f"{target}: not an HDF5 file; only path files can be sealed")
            with replacing(target) as partial, partial.open("wb") as sealed:
                file.seek(start)
                sealed.write(_block(file))
                file.seek(start)
                while chunk := file.read(_CHUNK):
                    sealed.write(chunk)
    except OSError as error:
        raise InputError(f"{target}: cannot be sealed ({error.strerror}); name a path file") from None


def write_checksum(partial: Path) -> str:
    """Write the checksum into the empty user block of an HDF5 file; returns it in hexadecimal."""
    with partial.open("r+b") as file:
        file.seek(BLOCK)
        block = _block(file)
        file.seek(0)
        file.write(block)
    return _digest(block)


def verify(path: Path) -> str:
    """Refuse a file whose content differs from the sealed one; returns its checksum in hexadecimal.

    Raises:
        InputError: The file is not a sealed HDF5 file, or was changed since; the message lacks its name.
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(BLOCK)
        if head.startswith(_SIGNATURE):
            raise InputError(
                "has no checksum; trace again, or call calibray.paths.seal if you trust the file"
            )
        if not head.startswith(PATH_SEAL):
            raise InputError("is damaged or no path file; trace again")
        if _block(file) != head:
            raise InputError("is damaged (its checksum does not agree); trace again")
    return _digest(head)


def _digest(block: bytes) -> str:
    return block[len(PATH_SEAL) :].split()[0].decode()


def _block(file: BinaryIO) -> bytes:
    """The user block for the content from the file's current position on."""
    start, digest = file.tell(), hashlib.sha256()
    while chunk := file.read(_CHUNK):
        digest.update(chunk)
    length = os.fstat(file.fileno()).st_size - start
    return (PATH_SEAL + f"{digest.hexdigest()} {length} bytes\n".encode()).ljust(BLOCK, b"\0")
