"""Stored traces, so that links are traced only once with the same scene, antennas, settings and versions.

Traces are stored in Calibray's cache folder (`support.cache_folder`). A damaged trace is removed, with a warning in the
log. If several users share the folder, each user's runs read only traces written by that user or root.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import numpy as np

from calibray.errors import InputError
from calibray.paths import FORMAT_VERSION, Paths
from calibray.scenes import Scene
from calibray.support.cache_folder import cache_folder
from calibray.support.output_files import NO_LINK
from calibray.tracing.protocol import Links
from calibray.tracing.settings import Antenna, TraceSettings

_FILE_NAME: Final = re.compile(r"[0-9a-f]{64}\.h5")
_LOG: Final = logging.getLogger(__name__)


def trace_digest(
    versions: Mapping[str, str],
    scene: Scene,
    frequency: float,
    settings: TraceSettings,
    antennas: tuple[Antenna, Antenna],
    links: Links,
) -> str:
    """Fingerprint (SHA-256, in hexadecimal) of all inputs that determine a trace.

    The scene's materials are included, because they influence the choice of a ray's next interaction.
    """
    record = {
        "calibray": version("calibray"),
        "format": FORMAT_VERSION,
        "tracer": dict(versions),
        "frequency": frequency,
        "settings": settings.record(),
        "antennas": [antenna.record() for antenna in antennas],
        "materials": {name: asdict(material) for name, material in scene.materials.items()},
        "objects": [asdict(scene_object) for scene_object in scene.objects],
    }
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode())
    digest.update(scene.xml.encode())
    for mesh in mesh_files(scene):
        digest.update(mesh.read_bytes())
    for position in (links.tx, links.rx):
        digest.update(np.ascontiguousarray(position, dtype=np.float64).tobytes())
    return digest.hexdigest()


def files_digest(scene: Scene, antennas: tuple[Antenna, Antenna]) -> str:
    """Fingerprint of the files that a tracer reads when it loads a scene: the meshes and the antennas' gain tables."""
    digest = hashlib.sha256(json.dumps([antenna.record() for antenna in antennas]).encode())
    for mesh in mesh_files(scene):
        digest.update(mesh.read_bytes())
    return digest.hexdigest()


def load_trace(digest: str) -> Paths | None:
    """Load the trace with a given fingerprint; None if there is no such trace, or if another user may have written it.

    A file that cannot be read is removed.
    """
    path = _path(digest)
    if path is None:
        return None
    try:
        stream = os.fdopen(os.open(path, os.O_RDONLY | NO_LINK), "rb")
    except OSError:  # the file does not exist or is a link
        return None
    with stream:
        if not _is_trusted(os.fstat(stream.fileno())):
            _LOG.warning(
                "%s: belongs to another user or is writable by others; the links are traced again", path
            )
            return None
        # In a shared folder, another user could replace the file after this check. Therefore, the file that is already
        # open is read if the system provides a path for it.
        opened = Path(f"/proc/self/fd/{stream.fileno()}")
        try:
            return Paths.load(opened if opened.exists() else path)
        except InputError as error:
            _LOG.warning(
                "A stored trace was removed, and its links are traced again: %s",
                str(error).replace(str(opened), str(path)),
            )
            with suppress(OSError):
                path.unlink()
            return None


def _is_trusted(status: os.stat_result) -> bool:
    """Whether a file can be trusted: it belongs to the user or root, and others cannot write to it."""
    if not stat.S_ISREG(status.st_mode):
        return False
    if not hasattr(os, "geteuid"):  # Windows keeps other users out of a user's folders
        return True
    return status.st_uid in (os.geteuid(), 0) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def store_trace(digest: str, paths: Paths) -> None:
    """Store a trace under its fingerprint, unless the cache folder cannot be written to."""
    path = _path(digest)
    if path is not None:
        with suppress(OSError, InputError):
            path.parent.mkdir(parents=True, exist_ok=True)
            paths.save(path)
            path.chmod(0o644)  # regardless of the umask: a file that others can write to is not read


def stored_traces() -> list[Path]:
    """The files of stored traces in the cache folder, newest first."""
    folder = cache_folder()
    if folder is None or not folder.is_dir():
        return []
    traces = [path for path in folder.iterdir() if _FILE_NAME.fullmatch(path.name) and path.is_file()]
    return sorted(traces, key=lambda path: path.stat().st_mtime, reverse=True)


def _path(digest: str) -> Path | None:
    folder = cache_folder()
    return None if folder is None else folder / f"{digest}.h5"


def mesh_files(scene: Scene) -> Iterator[Path]:
    """Yield the mesh files of a scene, in the order of the scene file."""
    for shape in ElementTree.fromstring(scene.xml).findall("shape"):
        filename = shape.find("string[@name='filename']")
        if filename is not None:
            yield scene.path.parent / filename.get("value", "")
