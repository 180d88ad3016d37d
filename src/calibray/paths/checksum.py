"""The seal of a path file: a checksum in front of it, compared before anything of the file is interpreted.

HDF5 lets a file begin with a block of the user's own. It holds the SHA-256 of all that follows, in one line of text. A
damaged file can make the HDF5 library wait for ever or end the process (of 3,000 files with flipped bits one did
each), so no byte reaches it before the checksum agrees.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import BinaryIO, Final

from calibray.errors import InputError
from calibray.support.output_files import PATH_SEAL, replacing

BLOCK: Final = 512
"""The bytes of the block; the least that HDF5 allows."""

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
_CHUNK: Final = 2**20


def seal(path: str | Path) -> None:
    """Put the checksum in front of an HDF5 file, or renew it: say that the file is as it should be.

    `Paths.save` does so by itself. It is for files from before there were seals, and for those that another program
    has changed on purpose.

    Args:
        path: The file.

    Raises:
        InputError: The file does not exist, is no HDF5 file, or cannot be written.
    """
    target = Path(path)
    try:
        with target.open("rb") as file:
            head = file.read(BLOCK)
            start = BLOCK if head.startswith(PATH_SEAL) or not any(head) else 0
            file.seek(start)
            if not file.read(len(_SIGNATURE)) == _SIGNATURE:
                raise InputError(f"{target}: is no HDF5 file; only path files can be sealed")
            with replacing(target) as partial, partial.open("wb") as sealed:
                file.seek(start)
                sealed.write(_block(file))
                file.seek(start)
                while chunk := file.read(_CHUNK):
                    sealed.write(chunk)
    except OSError as error:
        raise InputError(f"{target}: cannot be sealed ({error.strerror}); name a path file") from None


def stamp(path: Path) -> None:
    """Write the checksum into the block that an HDF5 file was made with.

    Args:
        path: The file, made with a user block of `BLOCK` bytes.
    """
    with path.open("r+b") as file:
        file.seek(BLOCK)
        block = _block(file)
        file.seek(0)
        file.write(block)


def verify(path: Path) -> bool:
    """Refuse a file that is not what was sealed.

    Args:
        path: The file.

    Returns:
        Whether it is sealed; files from before there were seals are not.

    Raises:
        InputError: The file is no HDF5 file, or has another content than when it was sealed; the message lacks its
            name.
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(BLOCK)
        if head.startswith(_SIGNATURE):
            return False
        if not head.startswith(PATH_SEAL):
            raise InputError("is damaged or no path file; trace again")
        if _block(file) != head:
            raise InputError("is damaged (its checksum does not agree); trace again")
        return True


def _block(file: BinaryIO) -> bytes:
    """The block for what follows in a file, from where it stands."""
    start, digest = file.tell(), hashlib.sha256()
    while chunk := file.read(_CHUNK):
        digest.update(chunk)
    length = os.fstat(file.fileno()).st_size - start
    return (PATH_SEAL + f"{digest.hexdigest()} {length} bytes\n".encode()).ljust(BLOCK, b"\0")
