"""`calibray predict`, `suggest` and `map`: predict path loss for new links or an area, and suggest where to measure."""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from calibray.cli.console import (
    Permissions,
    Pool,
    ResultFolder,
    echo,
    log,
    option,
    print_costs,
    progress_bars,
    with_groups,
)
from calibray.errors import InputError
from calibray.support.messages import shortened
from calibray.tables import Column, Table, numbers

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

PREDICTIONS: Final = ("path_loss_db", "lower_db", "upper_db")
"""Columns that `predict` adds; all columns except the first require --level. If the study measures a quantity other
than path loss, `predict` adds further columns."""

UNREACHED: Final = "no path"
"""The warning about links without a path."""

TEXTS: Final = ("basis", "remark")
"""Text columns that `predict` adds; the column `remark` requires --level."""


@with_groups
def predict(
    folder: ResultFolder,
    links_file: Annotated[
        Path,
        typer.Argument(
            metavar="LINKS",
            help="CSV or Parquet file with the position columns of the study, or tx_x, tx_y, tx_z, rx_x, rx_y, rx_z "
            "[m]. The file also needs the study's columns for the group of the offset and for the frequency, if any.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        option(
            "FILE",
            "CSV or Parquet file to write; without this option, CSV is printed to stdout.",
            "--out",
            "-o",
        ),
    ] = None,
    level: Annotated[
        float | None,
        option(
            "P",
            "Add the interval that contains a measurement with this probability, such as 0.9, as the columns lower_db "
            "and upper_db. Also add a remark if an antenna is inside a building or outside the scene, or if the link "
            "is far weaker than all links used in the calibration.",
        ),
    ] = None,
    *,
    pool: Pool,
    permissions: Permissions,
) -> None:
    """Predict path loss for new links with the calibrated scene.

    The column `basis` names the model used for each prediction. For links without a path, the log-distance model
    predicts path loss.
    """
    with progress_bars(log()) as progress:
        import numpy as np
        import pandas as pd

        from calibray.calibration.result import Result
        from calibray.engines import open_workers
        from calibray.measurements import PiecedTable
        from calibray.prediction.batches import predict_batches
        from calibray.prediction.observables import as_measured, observable_columns
        from calibray.prediction.predict import as_links
        from calibray.support.output_files import check_table, growing_table

        print_costs()
        result = Result.load(folder, allow_changed_inputs=permissions.allow_changed_inputs)
        study, table = result.study, PiecedTable.open(links_file)
        first = as_links(result, next(table.pieces(1)))
        names, texts = (PREDICTIONS[:1], TEXTS[:1]) if level is None else (PREDICTIONS, TEXTS)
        # Converting a prediction of NaN for the first link shows which columns the measured quantity adds.
        measured = as_measured(study, first, pd.DataFrame(np.nan, index=[0], columns=list(names)))
        further = observable_columns(study, level)
        renamed = _renamed_columns(links_file, first.frame, (*names, *measured, *further, *texts))
        if out is not None:
            check_table(out, [links_file, *study.files()], permissions.overwrite)
        warnings: dict[str, array[int]] = {}
        count = 0
        with (
            open_workers(pool.workers, pool.scheduler) as workers,
            _printer() if out is None else growing_table(out) as append,
        ):
            for links, predictions in predict_batches(
                result, table, level, progress, workers,
                allow_changed_inputs=permissions.allow_changed_inputs,
            ):  # fmt: skip
                columns = {name: predictions[name].to_numpy() for name in (*names, *texts)}
                measured = as_measured(study, links, predictions)
                measured |= {name: predictions[name].to_numpy() for name in further if name in predictions}
                # The order of the columns is predictions, basis, the measured quantity, remark.
                remark = {} if level is None else {"remark": columns.pop("remark")}
                append(links.frame.rename(columns=renamed).assign(**columns, **measured, **remark))
                _collect_warnings(warnings, links.row, predictions)
                count += len(links)
    for warning in sorted(warnings, key=lambda text: (text != UNREACHED, text)):
        _warn(warning, warnings[warning], count)
    if UNREACHED in warnings and result.prediction.fallback is not None:
        received = study.links.noise_floor_dbm is not None
        reason = (
            ". This model is fitted to links above the noise floor, so the true powers may be much lower"
            if received
            else ""
        )
        echo(
            f"For links without a path, the log-distance model predicts path loss; see the column basis{reason}",
            err=True,
        )
    if out is not None:
        echo(f"Written to {out}", err=True)


@contextmanager
def _printer() -> Iterator[Callable[[pd.DataFrame], None]]:
    """Yield a function that prints tables as CSV, with the header only before the first table."""
    from calibray.support.output_files import csv_text

    header = True

    def append(table: pd.DataFrame) -> None:
        nonlocal header
        typer.echo(csv_text(table, header=header), nl=False)
        header = False

    yield append


def _collect_warnings(
    warnings: dict[str, array[int]], row: NDArray[np.int64], predictions: pd.DataFrame
) -> None:
    """Add the row numbers of links without a path, and of links with remarks, to the warnings."""
    from calibray.result.held_out import NO_PATH

    rows: dict[str, list[int]] = {}
    if len(unreached := row[predictions["basis"].str.startswith(NO_PATH).to_numpy(bool)]):
        rows[UNREACHED] = unreached.tolist()
    for number, remarks in zip(row.tolist(), predictions["remark"].tolist(), strict=True):
        for remark in filter(None, remarks.split(", ")):
            rows.setdefault(remark, []).append(number)
    for warning, numbers_of_rows in rows.items():
        # An array needs 8 bytes per row, or 8 MB for a million rows; a list of integers would need 36 MB.
        warnings.setdefault(warning, array("q")).extend(numbers_of_rows)


def _warn(warning: str, rows: Sequence[int], count: int) -> None:
    from calibray.tables import rows_text

    if rows:
        echo(
            f"Warning: {warning}: {len(rows)} of {count} links, {rows_text([*dict.fromkeys(rows)])}", err=True
        )


def _renamed_columns(file: Path, frame: pd.DataFrame, columns: tuple[str, ...]) -> dict[str, str]:
    """Choose new names for table columns that have the same name as a prediction, such as measured path loss."""
    renamed = {name: f"input_{name}" for name in columns if name in frame}
    for name, new in renamed.items():
        if new in frame:
            raise InputError(f"{file}: has the columns {name!r} and {new!r}; rename or remove one")
        echo(f"{file}: its column {name!r} is written as {new!r}", err=True)
    return renamed


@dataclass(frozen=True)
class SuggestOptions:
    """Options for the suggestions and for their output."""

    count: Annotated[int, option("N", "Maximum number of links to suggest.", min=1)] = 5
    out: Annotated[
        Path | None, option("FILE", "Also write the table to this CSV or Parquet file.", "--out", "-o")
    ] = None
    observables: Annotated[
        bool,
        typer.Option(
            "--observables",
            help="Also report which further observable is worth measuring on each suggested link.",
        ),
    ] = False
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False


@with_groups
def suggest(
    folder: ResultFolder,
    candidates_file: Annotated[
        Path,
        typer.Argument(
            metavar="CANDIDATES",
            help="CSV or Parquet file of candidate links, with the same columns as for `calibray predict`.",
            show_default=False,
        ),
    ],
    options: SuggestOptions,
    permissions: Permissions,
) -> None:
    """Suggest where to measure next: the candidate links whose measurement should narrow the intervals most."""
    with progress_bars(log()) as progress:
        from calibray.calibration.result import Result
        from calibray.measurements.table_files import read_table
        from calibray.prediction.predict import as_links
        from calibray.prediction.suggestion import suggest as suggest_links
        from calibray.support.output_files import check_table, write_table
        from calibray.tables import render

        print_costs()
        result = Result.load(folder, allow_changed_inputs=permissions.allow_changed_inputs)
        study = result.study
        links = as_links(result, read_table(candidates_file))
        if options.out is not None:
            check_table(options.out, [candidates_file, *study.files()], permissions.overwrite)
        suggestion = suggest_links(
            result, links, options.count, progress,
            allow_changed_inputs=permissions.allow_changed_inputs, observables=options.observables,
        )  # fmt: skip
    echo(
        json.dumps(suggestion.to_dict("records"), indent=2)
        if options.as_json
        else render(*suggestion_tables(suggestion))
    )
    model = str(result.prediction.model.name)
    echo(
        "Note: the path loss shown is the mean over the draws of the calibrated model; `calibray predict`, which uses "
        f"the model {model!r}, may give other values.",
        err=True,
    )
    if options.out is not None:
        write_table(options.out, suggestion)
        echo(f"Written to {options.out}", err=True)


def suggestion_tables(suggestions: pd.DataFrame) -> tuple[Table, ...]:
    """Tables of the suggested positions, and of the gain expected from measuring each and those ranked above it."""
    from calibray.measurements.placement import POSITION_COLUMNS

    grouped = ["group"] if "group" in suggestions else []
    columns = (
        numbers("rank"),
        numbers("row"),
        *(numbers(name, "m") for name in POSITION_COLUMNS),
        *(Column(name) for name in grouped),
        numbers("path loss", "dB"),
        numbers("spread of draws", "dB"),
    )
    rows, gains = [], []
    for rank, row in enumerate(suggestions.to_dict("records"), start=1):
        losses = (f"{row['path_loss_db']:.1f}", f"{row['spread_db']:.1f}")
        position = (f"{row[name]:.2f}" for name in POSITION_COLUMNS)
        rows.append((str(rank), str(row["row"]), *position, *(str(row[name]) for name in grouped), *losses))
        gains.append((str(rank), row["gain"]))
    expected = Table(
        "Expected 95 % intervals after measuring this link and the links above",
        (numbers("rank"), Column("gain")),
        tuple(gains),
    )
    tables = Table("Where to measure next", columns, tuple(rows)), expected
    if "observable" not in suggestions:
        return tables
    worth = suggestions[["observable", "observable_gain"]].itertuples(index=False)
    further = Table(
        "Further observables to measure there",
        (
            numbers("rank"),
            Column("observable"),
            Column("expected 95 % intervals, relative to those with path loss alone"),
        ),
        tuple((str(rank), *(str(value) for value in row)) for rank, row in enumerate(worth, start=1)),
    )
    return *tables, further


@dataclass(frozen=True)
class Area:
    """Options for the transmitter, the receivers and the area of a map."""

    tx: Annotated[
        tuple[float, float, float] | None,
        option(
            "X Y Z",
            "Transmitter position [m]; by default that of the links' transmitter, if there is only one.",
        ),
    ] = None
    height: Annotated[float, option("M", "Height of the receivers above the ground [m].")] = 1.5
    cell: Annotated[float, option("M", "Width of the cells [m].")] = 5.0
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        option(
            "W S E N",
            "West, south, east and north limits of the area [m]; by default, the map covers the whole scene.",
        ),
    ] = None


@dataclass(frozen=True)
class Values:
    """Options for the predicted values."""

    level: Annotated[
        float, option("P", "Probability that a measurement lies in the interval; 0 omits the interval.")
    ] = 0.9
    power: Annotated[
        float | None, option("DBM", "Transmitted power [dBm], to map received power instead of path loss.")
    ] = None
    samples: Annotated[
        str | None,
        option(
            "N|auto",
            "Number of rays to use instead of the study's number. More rays take longer; too few rays miss paths.",
        ),
    ] = None
    column: Annotated[
        list[str] | None,
        option(
            "NAME=VALUE",
            "Value, for this transmitter, of a group or frequency column of the links; the option can be repeated.",
        ),
    ] = None


@with_groups
def map(
    folder: ResultFolder,
    area: Area,
    values: Values,
    out: Annotated[
        Path | None, option("FOLDER", "Folder for the map; by default DIR.", "--out", "-o")
    ] = None,
    *,
    pool: Pool,
    permissions: Permissions,
) -> None:
    """Predict path loss over an area and write map.tif (GeoTIFF), map.png and map.csv.

    In cells without a path, the log-distance model predicts path loss; these cells are hatched on the map.
    """
    target = out or folder
    with progress_bars(log()) as progress:
        import numpy as np

        from calibray.calibration.result import Result
        from calibray.engines import open_workers
        from calibray.prediction.coverage_map import coverage_map
        from calibray.prediction.map_files import FILES
        from calibray.support.output_files import check_outputs

        print_costs()
        result = Result.load(folder, allow_changed_inputs=permissions.allow_changed_inputs)
        inputs = result.study.files()
        # The outputs are checked before tracing, because tracing takes a long time.
        check_outputs(target, FILES, inputs, permissions.overwrite)
        with open_workers(pool.workers, pool.scheduler) as workers:
            coverage = coverage_map(
                result,
                area.tx,
                height=area.height,
                cell=area.cell,
                bounds=area.bounds,
                level=values.level or None,
                power_dbm=values.power,
                samples=None if values.samples is None else _samples(values.samples),
                columns=_columns(values.column or []),
                progress=progress,
                workers=workers,
                allow_changed_inputs=permissions.allow_changed_inputs,
            )
        progress("writing", 0, None)
        names = coverage.save(target, inputs, permissions.overwrite)
    predicted, without_path = int(np.isfinite(coverage.path_loss_db).sum()), int(coverage.no_path.sum())
    echo(
        f"{coverage.z.size:,} cells: {predicted - without_path:,} predicted by the model, {without_path:,} without a "
        f"path and predicted by the log-distance model (hatched), {coverage.z.size - predicted:,} blank (inside "
        "buildings)",
        err=True,
    )
    if len(names) < len(FILES):
        echo(
            "map.tif was not written: rasterio is not installed; run pip install 'calibray[scenes]'", err=True
        )
    echo(f"Written to {target}: {', '.join(names)}", err=True)


def _samples(text: str) -> int | Literal["auto"]:
    """The number of rays, or "auto"."""
    if text == "auto":
        return "auto"
    try:
        return int(text)
    except ValueError:
        raise InputError(f'--samples {shortened(text)}: must be a whole number or "auto"') from None


def _columns(entries: list[str]) -> dict[str, object]:
    """Read the values of columns from NAME=VALUE entries, and convert numeric values to numbers."""
    columns: dict[str, object] = {}
    for entry in entries:
        name, equals, value = entry.partition("=")
        if not equals or not name:
            raise InputError(f"--column {entry}: must be NAME=VALUE, such as sector=north")
        if name in columns:
            raise InputError(f"--column {entry}: {name} is given twice; remove one")
        try:
            # Python reads 1_2 as 12, but tables keep 1_2 as text.
            columns[name] = value if "_" in value else float(value)
        except ValueError:
            columns[name] = value
    return columns
