"""A comparison on a family as tables."""

from __future__ import annotations

import numpy as np

from calibray.optimizers.labels import label
from calibray.tables import Column, Table, numbers
from problem_families.comparison import CALLS, TOLERANCES_DB, FamilyComparison


def tables(comparison: FamilyComparison) -> tuple[Table, ...]:
    """What methods reached, and what they solved.

    Args:
        comparison: The comparison.

    Returns:
        A table of median, 90th percentile and worst excess at some RT calls; and one of data profiles for each
        tolerance.
    """
    shown = [calls for calls in CALLS if calls <= max(each.budget for each in comparison.contenders)]
    where = f"{comparison.kind}, seeds {comparison.seeds[0]} to {comparison.seeds[-1]}"
    columns = (Column("method"), *(numbers(f"at {calls}") for calls in shown), numbers("seconds a run"))
    rows = {(row["method"], row["calls"]): row for row in comparison.table().to_dict("records")}

    def cells(name: str, keys: tuple[str, ...], form: str) -> list[str]:
        found = []
        for calls in shown:
            if (name, calls) not in rows:
                found.append("-")
                continue
            values = [float(rows[name, calls][key]) for key in keys]
            found.append(" / ".join(form.format(value) if np.isfinite(value) else "none" for value in values))
        return found

    def table(title: str, keys: tuple[str, ...], form: str) -> Table:
        return Table(
            title,
            columns,
            tuple(
                (label(each.name), *cells(each.name, keys, form), f"{comparison.seconds(each.name):.1f}")
                for each in comparison.contenders
            ),
        )

    excess = ("median_excess_db", "p90_excess_db", "worst_excess_db")
    return (
        table(f"Excess [dB], median / 90th percentile / worst: {where}", excess, "{:.4f}"),
        *(
            table(f"Share of runs within {tolerance:g} dB: {where}", (f"solved_{tolerance:g}_db",), "{:.2f}")
            for tolerance in TOLERANCES_DB
        ),
    )
