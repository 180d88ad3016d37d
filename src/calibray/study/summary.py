"""A study in a few lines, for terminal and notebook."""

from __future__ import annotations

from calibray.study.calibration_sections import HoldoutSection
from calibray.study.content import OFFSET
from calibray.study.model import StudyModel
from calibray.tables import Column, Table, numbers
from calibray.tables.display import hertz


def _held_out(section: HoldoutSection) -> str:
    if section.where is not None:
        return section.where
    return f"{section.blocks} blocks in turn" if section.by is None else f"each {section.by} in turn"


def summary(study: StudyModel) -> tuple[Table, Table]:
    """The sections of a study and its parameters, as two tables."""
    rows = [
        ("scene", study.scene.file),
        ("frequency", hertz(study.scene.frequency)),
        ("links", f"{study.links.file}: {study.links.value}, {study.links.quantity}"),
        ("combining", study.objective.combining),
    ]
    for name, term in study.nuisance_terms.items():
        groups = f"per {' and '.join(term.per)}" if term.per else "one for all links"
        rows.append((name, groups if name == OFFSET else f"{term.by}, {groups}"))
    if study.holdout is not None:
        rows.append(("held out", _held_out(study.holdout)))
    rows.append(("method", f"{study.method.name}, seed {study.method.seed}"))
    rows.append(("engine", study.engine.name))
    bounds = tuple(
        (name, f"{entry.bounds[0]:g}", f"{entry.bounds[1]:g}", entry.scale)
        for name, entry in study.parameters.items()
    )
    columns = (Column(), numbers("lower"), numbers("upper"), Column("scale"))
    return (
        Table(f"Study {study.path.name}", (Column(), Column()), tuple(rows)),
        Table("Parameters", columns, bounds),
    )
