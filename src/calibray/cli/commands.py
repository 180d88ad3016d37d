"""The command line: parse, call, print.

Data goes to stdout, progress and messages to stderr. The exit status is 0 for done, 1 for failed while
running, 2 for bad input. Commands import what they need when they run, so that `--version` answers at once.
"""

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.console import Console
from typer.core import TyperGroup

from calibray.errors import EngineError, InputError

if TYPE_CHECKING:
    import pandas as pd

    from calibray.measurements import Measurements
    from calibray.tracing.enclosed import Enclosed
    from calibray.tracing.protocol import Tracer

PREDICTED: Final = "path_loss_db"  # the column that `predict` adds

log = Console(stderr=True, highlight=False)
"""Where progress and messages go; data goes to stdout through `typer.echo`."""


class Commands(TyperGroup):
    """A group of commands whose expected failures are one message and an exit status, not a traceback."""

    def invoke(self, ctx: typer.Context) -> object:
        """Runs the command.

        Args:
            ctx: What was parsed from the command line.

        Returns:
            What the command returns.

        Raises:
            typer.Exit: With 2 on bad input, with 1 when an engine failed.
        """
        try:
            return super().invoke(ctx)
        except InputError as error:
            typer.echo(f"Error: {error}", err=True)
            raise typer.Exit(2) from error
        except EngineError as error:
            typer.echo(f"Error: {error}", err=True)
            raise typer.Exit(1) from error


app = typer.Typer(
    cls=Commands,
    name="calibray",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
"""All commands; a module that adds one imports this and decorates with `@app.command()`."""


def _print_version(wanted: bool) -> None:
    """Prints the version and ends, if it was asked for."""
    if wanted:
        typer.echo(f"calibray {metadata.version('calibray')}")
        raise typer.Exit


@app.callback()
def calibray(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Calibrate the radio materials of a ray-traced scene from measurements."""


@app.command()
def doctor() -> None:
    """Tell what is installed, try whether tracing and replay work here, and say what to do if not."""
    from calibray.cli.doctor import examine, render

    with log.status("Trying Dr.Jit, Sionna RT and JAX"):
        diagnosis = examine()
    typer.echo(render(diagnosis))
    if not diagnosis.usable:
        raise typer.Exit(1)


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Folder to write figures and result into.")
    ] = Path("out/demo"),
    engine: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="replay (trace once), or retrace: run the ray tracer for every candidate, as the paper does.",
        ),
    ] = "replay",
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of the methods.")] = 0,
) -> None:
    """Run the paper's experiment in the embedded district: GWO, SGWO-IM and auto, with its tables and figures."""
    from calibray.comparison.experiment import FIGURES, run_demo, tables
    from calibray.report import terminal

    with terminal.progress_bars(log) as progress:
        finished = run_demo(out, engine, seed, progress)
    for title, header, rows in tables(finished):
        typer.echo(f"{title}\n{terminal.render_table(header, rows)}\n")
    typer.echo(f"Written to {out}: result.json, {', '.join(FIGURES)}, and a folder for each method", err=True)


StudyFile = Annotated[
    Path, typer.Argument(metavar="STUDY", help="The study file, in TOML.", show_default=False)
]


@app.command()
def run(
    study_file: StudyFile,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder to write the result into.")],
    method: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Method in place of the study's: auto, sgwo-im, gwo, ..."),
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed in place of the study's.")] = None,
    engine: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Engine in place of the study's: replay, retrace or command."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Programs of the engine 'command' that run at once here.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers run the engine 'command'."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON instead of tables.")
    ] = False,
) -> None:
    """Calibrate a study's materials, print the result, and write it with the calibrated scene."""
    from calibray.calibration import calibrate
    from calibray.engines import open_executor
    from calibray.report import terminal
    from calibray.result import FILES
    from calibray.study import Study

    study = Study.load(study_file).replace(engine=engine)
    with open_executor(workers, scheduler) as executor, terminal.progress_bars(log) as progress:
        result = calibrate(study, method, seed, out, executor=executor, progress=progress)
    if as_json:
        typer.echo(json.dumps(result.content() | {"links": terminal.summary(result, enclosed)}, indent=2))
    else:
        typer.echo(terminal.render_result(result, enclosed))
    typer.echo(f"Written to {out}: {', '.join(FILES)}", err=True)


@app.command()
def compare(
    study_file: StudyFile,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="DIR", help="Folder for tables and figure; finished runs are kept there."
        ),
    ],
    methods: Annotated[
        str,
        typer.Option(
            metavar="NAMES", help="Methods with commas between; METHOD@CALLS has a budget of its own."
        ),
    ] = "sgwo-im,gwo,gwo@600,vector-surrogate,gaussian-process,differential-evolution,random,least-squares",
    seeds: Annotated[int, typer.Option(metavar="N", help="Runs of each method, from seeds 0 to N - 1.")] = 25,
    budget: Annotated[int, typer.Option(metavar="CALLS", help="RT calls of a run.")] = 225,
    workers: Annotated[int, typer.Option(metavar="N", help="Processes that run at once.")] = 1,
) -> None:
    """Run methods from many seeds on a study's stored paths, at equal budgets of RT calls."""
    import os
    from functools import partial

    # The matrices are small: threads cost more than they give, and the runs are what is spread over cores.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(
            f"{library}_NUM_THREADS", "1"
        )  # read when NumPy is loaded, here and in the workers

    from calibray.comparison.arena import study_arena
    from calibray.comparison.comparison import compare as run_all
    from calibray.report import comparison as report
    from calibray.report import terminal

    names = [name.strip() for name in methods.split(",") if name.strip()]
    with terminal.progress_bars(log) as progress:
        finished = run_all(
            partial(study_arena, study_file),
            names, seeds=seeds, budget=budget, out=out, workers=workers, progress=progress,
        )  # fmt: skip
    report.write(finished, out)
    typer.echo(terminal.render_table(report.HEADINGS, report.rows(finished)))
    typer.echo(f"\nOptimum {finished.optimum:.6g} dB, found by {finished.found_by}")
    for name, seed, failure in finished.failures():
        typer.echo(f"Warning: {name}, seed {seed}: {failure}", err=True)
    typer.echo(f"Written to {out}: {', '.join(report.FILES)}", err=True)


@app.command()
def trace(
    study_file: StudyFile,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="HDF5 file to write the paths into.")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Trace again with twice the samples and another seed, and tell what changes."
        ),
    ] = False,
) -> None:
    """Find the paths of a study's links and store them as a path program, or check that enough rays were sent out."""
    from functools import partial

    from calibray.engines import make_tracer
    from calibray.fields import path_loss
    from calibray.files import check_file
    from calibray.progress import staged
    from calibray.report import terminal
    from calibray.study import Study
    from calibray.tracing import convergence

    study = Study.load(study_file)
    _refuse_idleness(out, check)
    if out is not None:
        check_file(out)
    links, tracer = study.measurements(), make_tracer(study)
    if told := terminal.render_plan(tracer.plan(links), len(links)):
        typer.echo(told, err=True)
    with terminal.progress_bars(log) as progress:
        paths = tracer.trace(links, progress)
        if out is not None:
            paths.save(out)
        found = (
            convergence.check(
                tracer,
                links,
                paths,
                partial(path_loss, combining=study.objective.combining, bandwidth=study.scene.bandwidth),
                staged(progress, "checking"),
            )
            if check
            else None
        )
    typer.echo(terminal.render_paths(paths, links.row, _enclosed(tracer, links)))
    if found is not None:
        typer.echo("\n" + terminal.render_convergence(found, links.row, study.fidelity.tolerance_db))
    if out is not None:
        typer.echo(f"Written to {out}", err=True)


def _refuse_idleness(out: Path | None, check: bool) -> None:
    """Refuse to trace for nothing."""
    if out is None and not check:
        raise InputError("trace: give -o FILE to store the paths, --check to check them, or both")


def _refuse_column(file: Path, frame: pd.DataFrame) -> None:
    """Refuse a table that has the column of predictions already."""
    if PREDICTED in frame:
        raise InputError(f"{file}: has a column {PREDICTED!r} already; rename or remove it")


@app.command()
def predict(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder that `calibray run` wrote.", show_default=False)
    ],
    links_file: Annotated[
        Path,
        typer.Argument(
            metavar="LINKS",
            help="CSV or Parquet file with the columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m], and the study's "
            "group column if its offset has one; its frequency column, if it has one, gives the carriers.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="CSV or Parquet file to write instead of CSV on stdout."
        ),
    ] = None,
) -> None:
    """Predict path loss at links that were never measured, with the calibrated scene."""
    import numpy as np

    from calibray.files import check_table, write_table
    from calibray.measurements import read_links
    from calibray.report import terminal
    from calibray.result import Result

    result = Result.load(folder)
    study = result.study
    links = read_links(
        links_file, group=study.offset.per if study.offset else None, frequency=study.links.frequency
    )
    _refuse_column(links_file, links.frame)
    if out is not None:
        check_table(out)
    with terminal.progress_bars(log) as progress:
        path_loss_db = result.predict(links, lambda done, total: progress("tracing", done, total))
    table = links.frame.assign(**{PREDICTED: path_loss_db})
    if out is None:
        typer.echo(table.to_csv(index=False), nl=False)
    else:
        write_table(out, table)
    lost = links.row[np.isinf(path_loss_db)].tolist()
    if lost:
        typer.echo(
            f"Warning: no path leads to {len(lost)} of {len(links)} links, {terminal.rows_text(lost)}",
            err=True,
        )


@app.command()
def ledger(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder that `calibray run` writes into.", show_default=False),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="CSV or Parquet file to write, with every link's path loss."
        ),
    ] = None,
    forget_failed: Annotated[
        bool, typer.Option("--forget-failed", help="Take out failed calls, so that they are run again.")
    ] = False,
) -> None:
    """List or export the RT calls that were paid for."""
    from contextlib import closing

    from calibray.engines import open_ledger
    from calibray.files import check_table, write_table
    from calibray.report import terminal

    if out is not None:
        check_table(out)
    with closing(open_ledger(folder)) as store:
        if forget_failed:
            typer.echo(f"Taken out: {store.forget_failures()} failed calls", err=True)
        table = store.table(path_loss=out is not None)
    if out is not None:
        write_table(out, table)
        typer.echo(f"Written to {out}: {len(table)} calls", err=True)
    else:
        typer.echo(terminal.render_table(*terminal.calls_table(table)))


def _enclosed(tracer: Tracer, links: Measurements) -> Enclosed:
    """Which antennas of some links stand inside closed bodies."""
    from calibray.tracing.enclosed import Enclosed

    return Enclosed.of(links.row, tracer.enclosed(links.tx), tracer.enclosed(links.rx))


def main() -> None:
    """Runs the command line of this process and ends it."""
    app()
