"""What a study, its links and what came of it say of themselves, in a few lines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from calibray.report import comparison as comparisons
from calibray.report import demo as demos
from calibray.report import result as results
from calibray.report.glance import named
from calibray.report.tables import Column, Table, numbers

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from calibray.comparison.comparison import Comparison
    from calibray.comparison.experiment import Demo
    from calibray.measurements import Measurements
    from calibray.result import Result
    from calibray.study import Study

Parts = tuple[Table | str, ...]
"""Tables and sentences, from top to bottom."""


_TOLD: Final = ("method", "RT calls", "at the end", "quartiles", "worst", "failed")


def measurements(links: Measurements) -> Parts:
    """Where links come from, and the range of what was measured.

    Args:
        links: The links.

    Returns:
        A table.
    """
    kind = "measured" if links.measured else "unmeasured"
    rows = [("number", f"{len(links):,} {kind}"), ("distance", _range(links.distance, "m"))]
    if links.measured:
        rows.append(("path loss", _range(links.path_loss_db, "dB")))
    if links.group is not None:
        rows.append(("groups", named(links.group_names)))
    if links.carriers:
        rows.append(("carriers", named(_hertz(frequency) for frequency, _ in links.carriers)))
    return (Table(f"Links from {links.source}", (Column(), Column()), tuple(rows)),)


def study(plan: Study) -> Parts:
    """What a study calibrates, on what, and how.

    Args:
        plan: The study.

    Returns:
        Its sections in a table, and its parameters in another.
    """
    rows = [
        ("scene", plan.scene.file),
        ("frequency", _hertz(plan.scene.frequency)),
        ("links", f"{plan.links.file}: {plan.links.value}, {plan.links.quantity}"),
        ("combining", plan.objective.combining),
    ]
    if plan.offset is not None:
        rows.append(("offset", f"per {plan.offset.per}" if plan.offset.per else "one for all links"))
    if plan.holdout is not None:
        rows.append(("held out", plan.holdout.where))
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


def result(found: Result) -> Parts:
    """What a calibration found, and how far to trust it.

    Args:
        found: The calibration.

    Returns:
        Its heading with the RT calls spent, and its tables of parameters, offsets and accuracy.
    """
    tables = (results.parameters(found), results.offsets(found), results.accuracy(found))
    heading = f"{results.heading(found)}, {found.rt_calls:,} RT calls"
    return (heading, *(table for table in tables if table.rows))


def comparison(finished: Comparison) -> Parts:
    """Methods side by side.

    Args:
        finished: The comparison.

    Returns:
        Its name, what matters of its table, and the optimum.
    """
    table = comparisons.table(finished)
    chosen = [k for k, column in enumerate(table.columns) if column.name in _TOLD]
    short = Table(
        "",
        tuple(table.columns[k] for k in chosen),
        tuple(tuple(row[k] for k in chosen) for row in table.rows),
    )
    heading = f"Methods on {finished.name}, excess over the optimum with all RT calls spent"
    return heading, short, comparisons.optimum(finished)


def demo(finished: Demo) -> Parts:
    """The paper's experiment.

    Args:
        finished: The experiment.

    Returns:
        The engine, and the tables of permittivities and RMSE.
    """
    return (
        f"The paper's experiment, engine {finished.engine}",
        demos.permittivity(finished),
        demos.accuracy(finished),
    )


def _range(values: NDArray[np.float64], unit: str) -> str:
    return f"{values.min():.4g} to {values.max():.4g} {unit}"


def _hertz(frequency: float) -> str:
    """A frequency [Hz] in GHz or MHz."""
    return f"{frequency / 1e9:.6g} GHz" if frequency >= 1e9 else f"{frequency / 1e6:.6g} MHz"
