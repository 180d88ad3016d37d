"""`calibray run`, `demo`, `trace`, `report` and `export`: calibrate a study, trace its links, and write a result."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.cli.console import (
    Overwrite,
    Permissions,
    Pool,
    ResultFolder,
    StudyFile,
    echo,
    log,
    option,
    progress_bars,
    warn,
    with_groups,
)
from calibray.errors import InputError
from calibray.support.messages import command, counted

if TYPE_CHECKING:
    from calibray.calibration.result import Result
    from calibray.paths import Paths
    from calibray.study import Setup
    from calibray.study.model import StudyModel
    from calibray.support.progress import Progress
    from calibray.tracing.convergence import Convergence
    from calibray.tracing.settings import TraceSettings


@dataclass(frozen=True)
class Changes:
    """Options that override settings of the study."""

    method: Annotated[
        str | None, option("NAME", "Method to use instead of the study's method: auto, sgwo-im, gwo, ...")
    ] = None
    seed: Annotated[int | None, option("N", "Seed to use instead of the study's seed.")] = None
    engine: Annotated[
        str | None, option("NAME", "Engine to use instead of the study's engine: replay, retrace or command.")
    ] = None


@dataclass(frozen=True)
class RunPool:
    """Options for the workers; these can also run an external program."""

    workers: Annotated[
        int | None,
        option(
            "N",
            "Number of local processes among which the chunks of links are divided, or number of programs that the "
            "engine 'command' runs in parallel.",
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        option(
            "ADDRESS",
            "Address of the Dask scheduler whose workers process chunks of links, or run the engine 'command'.",
        ),
    ] = None


@dataclass(frozen=True)
class Output:
    """Options for the output that is printed or written to files."""

    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON instead of tables.")] = (
        False
    )
    overwrite: Overwrite = False
    figures: Annotated[
        bool, typer.Option("--figures", help="Also write the figures of the report as SVG and PNG.")
    ] = False


@with_groups
def run(
    study_file: StudyFile,
    out: Annotated[Path, option("DIR", "Folder for the result.", "--out", "-o")],
    changes: Changes,
    pool: RunPool,
    output: Output,
) -> None:
    """Calibrate a study, print the result, and write the result, the calibrated scene and a report."""
    try:
        # Importing libraries and reading the scene also take several seconds, so the progress display starts here.
        with progress_bars(log()) as progress:
            from calibray.calibration.calibrate import calibrate
            from calibray.engines import open_workers
            from calibray.fitting.search import check_method
            from calibray.reporting import result_tables as tables
            from calibray.result.files import FILES
            from calibray.study import Study
            from calibray.support.output_files import check_outputs
            from calibray.tables import render

            study = Study.load(study_file).replace(changes.method, changes.seed, changes.engine)
            check_method(study.method.name)
            check_outputs(out, FILES, study.files(), output.overwrite)
            setup = study.opened()
            warn(study, setup.links)
            with open_workers(pool.workers, pool.scheduler) as workers:
                result = calibrate(
                    setup, out=out, workers=workers, progress=progress, overwrite=output.overwrite
                )
    except KeyboardInterrupt:
        echo(_kept_text(out), err=True)
        raise
    if output.as_json:
        echo(json.dumps(result.content(), indent=2))
    else:
        echo(render(tables.heading(result), *tables.tables(result)))
    names = [*FILES, *_write_report(result, out, output)]
    judge = result.accuracy.judgement is None and result.study.allows_blocks
    following = command("validate", study_file, "--out", out) if judge else command("predict", out, "LINKS")
    if note := _earlier_map_text(out):
        echo(note, err=True)
    echo(f"Written to {out}: {', '.join(names)}; next: {following}", err=True)


def _earlier_map_text(out: Path) -> str:
    """Return a note if the folder contains the map of an earlier calibration; without a map, the text is empty."""
    from calibray.prediction.map_files import FILES
    from calibray.support.output_files import is_unchanged_output

    files = [name for name in FILES if (out / name).is_file() and is_unchanged_output(out / name)]
    if not files:
        return ""
    return (
        f"Note: the map in {out} ({', '.join(files)}) belongs to an earlier run; draw the map again with: "
        + command("map", out)
    )


def _kept_text(out: Path) -> str:
    """A message that states which results an interrupted run has kept, and how to continue the run."""
    from contextlib import closing, suppress

    from calibray.engines import open_ledger
    from calibray.engines.ledger.ledger import LEDGER_FILE
    from calibray.support.cache_folder import cache_folder
    from calibray.tracing.cache import stored_traces

    parts = []
    if (out / LEDGER_FILE).is_file():
        with suppress(InputError), closing(open_ledger(out)) as ledger:  # it may be another program's
            parts.append(f"{counted(len(ledger.table()), 'RT call')} in {out / LEDGER_FILE}")
    if stored_traces():
        parts.append(f"finished traces in {cache_folder()}")
    kept = f"Kept: {' and '.join(parts)}." if parts else "Nothing was finished, so nothing is kept."
    return f"{kept} Start the same command again to continue; kept results are not computed again."


def _write_report(result: Result, out: Path, output: Output) -> list[str]:
    """Write the report next to the saved result; if this fails, only a warning is printed."""
    try:
        from calibray.reporting import page

        folder = out / page.FIGURES if output.figures else None
        with progress_bars(log()) as progress:
            progress("writing", 0, None)
            page.report(
                result, out / page.FILE, figures=folder, overwrite=output.overwrite, progress=progress
            )
    except Exception as error:
        echo(
            f"Warning: the report was not written ({error}); try again with: {command('report', out)}",
            err=True,
        )
        return []
    return [page.FILE, *([f"{page.FIGURES}/"] if output.figures else [])]


def demo(
    out: Annotated[
        Path, option("DIR", "Folder for tables, figures, results and the report.", "--out", "-o")
    ] = Path("out/demo"),
    engine: Annotated[
        str,
        option(
            "NAME",
            "Engine: replay (trace once) or retrace (run the ray tracer for every candidate, as in the paper).",
        ),
    ] = "replay",
    seed: Annotated[int, option("N", "Seed of the methods.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Run the experiment of the paper in the demo district, and write tables, figures and a report."""
    with progress_bars(log()) as progress:
        from calibray.comparison.demo import FILES, run_demo, write_demo
        from calibray.support.output_files import check_outputs
        from calibray.tables import render

        check_outputs(out, FILES, (), overwrite)
        finished = run_demo(engine, seed, progress)
        progress("writing", 0, None)
        page = write_demo(finished, out)
    echo(render(*finished.tables()) + "\n")
    echo(f"Written to {out}: {', '.join(FILES)}, and a folder for each method", err=True)
    echo(f"Report: {page}")


@with_groups
def trace(
    study_file: StudyFile,
    out: Annotated[Path | None, option("FILE", "HDF5 file for the paths.", "--out", "-o")] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Trace again with twice the samples and a different seed, and show by how much path loss changes. If "
            "trace.samples is 'auto', show the changes that the last round of rays caused.",
        ),
    ] = False,
    *,
    pool: Pool,
    overwrite: Overwrite = False,
) -> None:
    """Trace the links of a study and store the paths, or check whether the number of rays is sufficient."""
    with progress_bars(log()) as progress:
        from calibray.engines import open_workers
        from calibray.engines.cluster.chunks import stated_chunk_size, trace_in_chunks
        from calibray.engines.cluster.workers import InProcess
        from calibray.reporting import scene_tables
        from calibray.study import Study
        from calibray.support.output_files import check_file
        from calibray.tables import render

        study = Study.load(study_file)
        if out is None and not check:
            raise InputError("trace: give -o FILE to store the paths, --check to check them, or both")
        if check and not _traces(study):
            raise InputError(
                f"--check: {study.path} reads its paths from engine.rays, so no rays are traced; omit --check"
            )
        if out is not None:
            check_file(out, study.files(), overwrite)
        setup = study.opened()
        links, trace_again = setup.links, check and not study.trace.adaptive
        with open_workers(pool.workers, pool.scheduler) as workers:
            if workers is None and stated_chunk_size(setup) is None:
                paths, change = _trace(setup, out, overwrite, trace_again, progress)
            else:
                paths, change = trace_in_chunks(
                    setup, workers or InProcess(), check=trace_again, progress=progress
                )
                if out is not None:
                    paths.save(out, overwrite)
    echo(render(scene_tables.overview(paths, links.row, setup.enclosed)))
    if check and study.trace.adaptive:
        echo("\n" + scene_tables.last_round(paths.settings, study.fidelity.tolerance_db))
    if change is not None:
        echo("\n" + render(*scene_tables.convergence(change, links.row, study.fidelity.tolerance_db)))
    if out is not None:
        echo(f"Written to {out}", err=True)


def _traces(study: StudyModel) -> bool:
    """Whether the paths of a study come from the ray tracer rather than from a table or an external program."""
    return study.rays_path is None and not study.engine.exports_rays


def _trace(
    setup: Setup, out: Path | None, overwrite: bool, trace_again: bool, progress: Progress
) -> tuple[Paths, Convergence | None]:
    """Trace all links together, store the paths and, if requested, trace again as a check."""
    from functools import partial

    from calibray.fields import path_loss
    from calibray.support.progress import with_stage
    from calibray.tracing import convergence

    study, links = setup.study, setup.links
    if _traces(study) and (announcement := setup.tracer.plan(links).announcement(len(links))):
        echo(announcement, err=True)
    # As in a calibration, `setup.trace` applies the antennas and facades of the study.
    paths = setup.trace(progress=progress)
    if out is not None:
        paths.save(out, overwrite)
    if not trace_again:
        return paths, None
    loss = partial(path_loss, combining=study.objective.combining, bandwidth=study.scene.bandwidth)

    def finer(settings: TraceSettings) -> Paths:
        return setup.with_trace(settings).trace(progress=with_stage(progress, "checking"))

    return paths, convergence.check(study.trace, finer, paths, loss)


@with_groups
def report(
    folder: ResultFolder,
    out: Annotated[
        Path | None, option("FILE", "HTML file to write instead of DIR/report.html.", "--out", "-o")
    ] = None,
    figures: Annotated[
        bool, typer.Option("--figures", help="Also write the figures as SVG and PNG into DIR/figures.")
    ] = False,
    *,
    permissions: Permissions,
) -> None:
    """Write the report of a result as one HTML file with a summary, values, figures, a map and the scene in 3-D."""
    with progress_bars(log()) as progress:
        from calibray.calibration.result import Result
        from calibray.engines.ledger.ledger import LEDGER_FILE
        from calibray.reporting.page import FIGURES, FILE
        from calibray.reporting.page import report as write_report
        from calibray.reporting.viewer import with_stored_paths

        result = Result.load(folder, allow_changed_inputs=permissions.allow_changed_inputs)
        file = write_report(
            with_stored_paths(result, folder / LEDGER_FILE),
            out or folder / FILE,
            figures=folder / FIGURES if figures else None,
            overwrite=permissions.overwrite,
            progress=progress,
        )
    echo(f"Written to {file}", err=True)


@with_groups
def export(
    folder: ResultFolder,
    out: Annotated[Path, option("FOLDER", "Folder to write into.", "--out", "-o", show_default=False)],
    copy: Annotated[
        bool, typer.Option("--copy", help="Copy the meshes too, so that the folder is self-contained.")
    ] = False,
    *,
    permissions: Permissions,
) -> None:
    """Write the calibrated scene for Sionna RT, a script that loads it, and its materials as tables."""
    from calibray.calibration.result import Result
    from calibray.reporting.export import export as write
    from calibray.reporting.wording import sampling_text, scene_alone_text

    result = Result.load(folder, allow_changed_inputs=permissions.allow_changed_inputs)
    names = write(
        result, out, copy, permissions.overwrite, allow_changed_inputs=permissions.allow_changed_inputs
    )
    for note in filter(None, (scene_alone_text(result), sampling_text(result))):
        echo(f"Note: {note}", err=True)
    echo(f"Written to {out}: {', '.join(names)}", err=True)
