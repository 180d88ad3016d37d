"""The paper's tables: our figures and the paper's side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calibray.optimizers.methods import label
from calibray.result.tables import ends_text
from calibray.tables import Column, Table, numbers

if TYPE_CHECKING:
    from calibray.comparison.experiment import Demo


def tables(demo: Demo) -> tuple[Table, ...]:
    """The tables of the paper's experiment.

    Args:
        demo: The experiment.

    Returns:
        Cost, permittivities, RMSE, and how far to trust the answer of `auto`.
    """
    return cost(demo), permittivity(demo), accuracy(demo), trust(demo)


def cost(demo: Demo) -> Table:
    """RT calls and time.

    Args:
        demo: The experiment.

    Returns:
        The table.
    """
    columns = (
        Column("method"), numbers("RT calls"), numbers("time", "s"),
        numbers("paper: calls"), numbers("paper: time", "s"),
    )  # fmt: skip
    rows = tuple(
        (
            label(method),
            str(result.rt_calls),
            f"{result.seconds:.2f}",
            *_paper(demo, method, "rt_calls", "seconds"),
        )
        for method, result in demo.results.items()
    )
    return Table("Cost", columns, rows)


def permittivity(demo: Demo) -> Table:
    """What every method found, what was planted, and what the paper found at its own site.

    Args:
        demo: The experiment.

    Returns:
        The table.
    """
    columns = (
        Column("material"),
        Column("before"),
        *(Column(label(method)) for method in demo.results),
        Column("planted mean"),
        *(Column(f"paper: {label(method)}") for method in demo.paper),
    )
    first = next(iter(demo.results.values()))
    rows = []
    for parameter, before in first.initial_parameters.items():
        material = parameter.split(".")[0]
        found = (result.parameters[parameter] for result in demo.results.values())
        planted = demo.truth[material]
        reported = (figures[material] for figures in demo.paper.values())
        rows.append((material, *(f"{value:.2f}" for value in (before, *found, planted, *reported))))
    return Table("Relative permittivity", columns, tuple(rows))


def accuracy(demo: Demo) -> Table:
    """RMSE before and after, and its excess over the global optimum.

    Args:
        demo: The experiment.

    Returns:
        The table.
    """
    columns = (
        Column("method"), numbers("before"), numbers("after"), numbers("excess"), numbers("paper: after")
    )  # fmt: skip
    rows = tuple(
        (
            label(method),
            f"{result.initial_rmse_db:.2f}",
            f"{result.rmse_db:.3f}",
            f"{result.rmse_db - demo.optimum_db:.4f}",
            *_paper(demo, method, "rmse_db"),
        )
        for method, result in demo.results.items()
    )
    return Table("RMSE [dB]", columns, rows)


def trust(demo: Demo) -> Table:
    """How far to trust what `auto` found.

    Args:
        demo: The experiment, `auto` last.

    Returns:
        The table.
    """
    *_, auto = demo.results.values()
    columns = (Column("parameter"), numbers("value"), numbers("95 % interval"), Column("verdict"))
    rows = tuple(
        (name, f"{auto.parameters[name]:.2f}", ends_text(found), found.told)
        for name, found in auto.intervals.items()
    )
    return Table("How far to trust auto's answer", columns, rows)


def _paper(demo: Demo, method: str, *keys: str) -> tuple[str, ...]:
    known = demo.paper.get(method, {})
    return tuple(f"{known[key]:g}" if key in known else "-" for key in keys)


def summary(finished: Demo) -> tuple[Table | str, ...]:
    """The paper's experiment.

    Args:
        finished: The experiment.

    Returns:
        The engine, and the tables of permittivities and RMSE.
    """
    return (
        f"The paper's experiment, engine {finished.engine}",
        permittivity(finished),
        accuracy(finished),
    )
