"""`calibray map`: predict path loss over an area."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from calibray.cli.console import Permissions, Pool, ResultFolder, echo, log, print_costs, with_groups
from calibray.errors import InputError
from calibray.support.messages import shortened


@dataclass(frozen=True)
class Area:
    """Options that state the transmitter and the receivers of a map."""

    tx: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="Transmitter position [m]; by default that of the links, if they have only one transmitter.",
        ),
    ] = None
    height: Annotated[
        float, typer.Option(metavar="M", help="Height of the receivers above the ground [m].")
    ] = 1.5
    cell: Annotated[float, typer.Option(metavar="M", help="Width of the cells [m].")] = 5.0
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            metavar="W S E N",
            help="West, south, east and north end of the area [m]; by default the whole scene.",
        ),
    ] = None


@dataclass(frozen=True)
class Values:
    """Options that state what is predicted, and how."""

    level: Annotated[
        float,
        typer.Option(
            metavar="P", help="Probability that a measurement lies in the interval; 0 for no interval."
        ),
    ] = 0.9
    power: Annotated[
        float | None,
        typer.Option(metavar="DBM", help="Transmit power [dBm], for received power instead of path loss."),
    ] = None
    samples: Annotated[
        str | None,
        typer.Option(
            metavar="N|auto",
            help="Number of rays, in place of the study's. The time grows with this number; too few rays miss paths.",
        ),
    ] = None
    column: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="Value of a group or frequency column of the links for this transmitter; can be repeated.",
        ),
    ] = None


@with_groups
def map(
    folder: ResultFolder,
    area: Area,
    values: Values,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FOLDER", help="Folder for the map instead of DIR.")
    ] = None,
    *,
    pool: Pool,
    permissions: Permissions,
) -> None:
    """Predict path loss over an area and write map.tif (GeoTIFF), map.png and map.csv.

    For cells without a path, the log-distance model predicts; the map hatches these cells.
    """
    from calibray.cli.progress_bars import progress_bars

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
        # Checked before the tracing, which takes long.
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
        f"path by the log-distance model (hatched), {coverage.z.size - predicted:,} blank (inside buildings)",
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
    """Values by column, as numbers if they are numeric."""
    columns: dict[str, object] = {}
    for entry in entries:
        name, equals, value = entry.partition("=")
        if not equals or not name:
            raise InputError(f"--column {entry}: must be NAME=VALUE, such as sector=north")
        try:
            columns[name] = float(value)
        except ValueError:
            columns[name] = value
    return columns
