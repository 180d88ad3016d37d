"""A study's folder: the files that the command line reads and writes, and nothing else."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from calibray.errors import InputError
from calibray.support.messages import shortened
from calibray.support.output_files import write_text

STUDY: Final = "study.toml"
MAPS: Final = (".osm", ".pbf", ".geojson", ".gpkg", ".shp", ".dxf", ".csv")
TABLES: Final = (".csv", ".xlsx", ".parquet")
MESHES: Final = (".ply", ".obj")
PARTS: Final = (".shx", ".dbf", ".prj", ".cpg", ".tif", ".tiff", ".gpx", ".xml", ".json", ".msi")
LARGEST: Final = 2**30
"""Largest size of an uploaded file [bytes]; put larger files into the folder."""

_NAME: Final = re.compile(r"[\w][\w .()+-]{0,119}")


@dataclass(frozen=True)
class StudyFolder:
    """A study's folder.

    Attributes:
        path: The folder, absolute.
    """

    path: Path

    @property
    def study_file(self) -> Path:
        """The study file, which may not exist yet."""
        return self.path / STUDY

    def files(self, endings: tuple[str, ...]) -> list[str]:
        """Names of the folder's files with one of the extensions."""
        candidates = (file for file in self.path.iterdir() if file.name.lower().endswith(endings))
        return sorted(file.name for file in candidates if file.is_file() and not file.name.startswith("."))

    def scenes(self) -> list[str]:
        """The scenes of the folder and of its subfolders, except those of results."""
        files = [*self.path.glob("*.xml"), *self.path.glob("*/*.xml")]
        names = (file.relative_to(self.path).as_posix() for file in files if file.name != "result-scene.xml")
        return sorted(name for name in names if not name.startswith("."))

    def results(self) -> list[str]:
        """The folders with results."""
        return sorted(file.parent.name for file in self.path.glob("*/result.json") if file.is_file())

    def result(self, name: str) -> dict[str, Any]:
        """The record of a result.

        Raises:
            InputError: The result does not exist, or cannot be read.
        """
        if name not in self.results():
            raise InputError(f"{shortened(name)}: no such result")
        file = self.path / name / "result.json"
        try:
            return json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{file}: cannot be read ({shortened(str(error))})") from None

    def check_upload(self, name: str) -> Path:
        """The path at which an uploaded file is stored; meshes go to `meshes`, where scenes expect them.

        Raises:
            InputError: The name is not a plain file name, Calibray does not read this kind of file, or the file exists.
        """
        shown = shortened(ascii(name))
        if not _NAME.fullmatch(name) or name.endswith((" ", ".")):
            raise InputError(
                f"{shown}: use letters, digits, spaces, and . _ - ( ) + in names of files; rename it"
            )
        ending = Path(name).suffix.lower()
        if ending not in (*MAPS, *TABLES, *PARTS, *MESHES):
            raise InputError(
                f"{shown}: files of this kind are not read; give a map, a plan, a table or a scene"
            )
        target = (self.path / "meshes" if ending in MESHES else self.path) / name
        if target.exists() or target.is_symlink():
            raise InputError(f"{shown}: already exists; rename one of them")
        return target

    def content(self) -> dict[str, Any]:
        """The sections of the study file; empty without one or if it is not TOML."""
        try:
            return tomllib.loads(self.study_file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return {}

    def text(self) -> str:
        """The study file; empty without one."""
        try:
            return self.study_file.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""

    def reasons(self) -> dict[str, str]:
        """Reasons by the dotted name of a section or key, from the comments of a draft."""
        from calibray.study.toml_file import reasons_in

        return reasons_in(self.text())

    def save(self, content: Mapping[str, Any]) -> None:
        """Write the study file, with its reasons as comments.

        Raises:
            InputError: The content is not a study; the file is unchanged.
        """
        from calibray.study import Study
        from calibray.study.toml_file import study_text

        text = study_text(content, self.reasons())
        Study.from_content(tomllib.loads(text), self.study_file)
        write_text(self.study_file, text)

    def set_aside(self) -> None:
        """Rename the study file, so that another one can be drafted."""
        number = 1
        while (target := self.path / f"study-{number}.toml").exists():
            number += 1
        self.study_file.rename(target)
