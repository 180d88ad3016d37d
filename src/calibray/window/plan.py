"""The content of the window's map: outlines of the scene, and links with their values and suspicions."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibray.reporting.link_map import lay_out
from calibray.scenes import read_scene, read_triangles
from calibray.scenes.checks import SceneSurfaces
from calibray.study import Study
from calibray.study.link_checks import count_unknowns, examine
from calibray.window.folder import StudyFolder


def plan(folder: StudyFolder, scene: str | None) -> dict[str, Any]:
    """The map of a study, or of a scene if there is no study.

    Args:
        folder: The study's folder.
        scene: A scene of the folder, relative to it.

    Returns:
        `west`, `north` [m] and `scale` [1/m] of the outlines, `buildings` and `walls` as data of SVG paths; `links`,
        each with x, y [m], path loss [dB] and 1 where it is suspicious; `transmitters`, x, y, z [m].

    Raises:
        InputError: The scene or the links cannot be read.
    """
    source, study = opened(folder, scene)
    if source is None:
        return {"links": [], "transmitters": []}
    links = None if study is None else study.measurements()
    triangles = read_triangles(read_scene(source, 1e9 if study is None else study.scene.frequency))
    corners = triangles.corners.reshape(-1, 3)
    measured = [] if links is None else [links.tx, links.rx]
    layout = lay_out(np.concatenate([corners, *measured]), triangles)
    shown: dict[str, Any] = {
        "west": layout.west, "north": layout.north, "scale": layout.scale, "height": layout.height,
        "buildings": layout.buildings, "walls": layout.walls, "links": [], "transmitters": [],
    }  # fmt: skip
    if study is None or links is None:
        return shown
    overhead = SceneSurfaces.read(source)
    roofed, wrong = overhead.under_roof(links.rx), overhead.outside(links.rx) | overhead.underground(links.rx)
    suspicious = wrong if roofed.mean() > 0.8 else wrong | roofed
    rows = zip(links.rx.tolist(), links.path_loss_db.tolist(), suspicious.tolist(), strict=True)
    shown["links"] = [[round(x, 2), round(y, 2), round(loss, 1), int(mark)] for (x, y, _), loss, mark in rows]
    shown["transmitters"] = np.unique(links.tx, axis=0).round(2).tolist()
    return shown


def opened(folder: StudyFolder, scene: str | None) -> tuple[str | None, Study | None]:
    """The scene of a folder and its study: the study's scene, or the chosen one if there is no study.

    Raises:
        InputError: The study cannot be read.
    """
    if folder.study_file.is_file():
        study = Study.load(folder.study_file)
        return study.scene_source, study
    if scene is None or scene not in folder.scenes():
        return None, None
    return str(folder.path / scene), None


def findings(folder: StudyFolder) -> list[str]:
    """Suspicions about the links of a study, as sentences; none without a study.

    Raises:
        InputError: The scene or the links cannot be read.
    """
    if not folder.study_file.is_file():
        return []
    study = Study.load(folder.study_file)
    links = study.measurements()
    suspicions = [*examine(study, links), *count_unknowns(study, links)]
    return [f"{suspicion.problem}: {suspicion.remedy}" for suspicion in suspicions]
