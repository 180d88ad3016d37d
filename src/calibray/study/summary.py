"""What a study says of itself, in a few lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calibray.tables import Column, Table, numbers
from calibray.tables.display import hertz

if TYPE_CHECKING:
    from calibray.study.model import Study
    from calibray.study.sections import HoldoutSection


def held_out(section: HoldoutSection) -> str:
    """Which links are held out, in words.

    Args:
        section: How they are chosen.

    Returns:
        The filter, or what is held out in turn.
    """
    if section.where is not None:
        return section.where
    return f"{section.blocks} blocks in turn" if section.by is None else f"each {section.by} in turn"


def summary(plan: Study) -> tuple[Table, ...]:
    """What a study calibrates, on what, and how.

    Args:
        plan: The study.

    Returns:
        Its sections in a table, and its parameters in another.
    """
    rows = [
        ("scene", plan.scene.file),
        ("frequency", hertz(plan.scene.frequency)),
        ("links", f"{plan.links.file}: {plan.links.value}, {plan.links.quantity}"),
        ("combining", plan.objective.combining),
    ]
    if plan.offset is not None:
        per = plan.offset.per
        names = per if isinstance(per, str) else " and ".join(per or ())
        rows.append(("offset", f"per {names}" if names else "one for all links"))
    if plan.holdout is not None:
        rows.append(("held out", held_out(plan.holdout)))
    rows += [
        (name, f"{term.by}, per {term.per}" if term.per else term.by) for name, term in plan.nuisance.items()
    ]
    rows.append(("method", f"{plan.method.name}, seed {plan.method.seed}"))
    rows.append(("engine", plan.engine.name))
    bounds = tuple(
        (name, f"{entry.bounds[0]:g}", f"{entry.bounds[1]:g}", entry.scale)
        for name, entry in plan.parameters.items()
    )
    columns = (Column(), numbers("lower"), numbers("upper"), Column("scale"))
    return (
        Table(f"Study {plan.path.name}", (Column(), Column()), tuple(rows)),
        Table("Parameters", columns, bounds),
    )
