"""`calibray trace`: find paths and store them, or check that enough rays were sent out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.cli.console import Overwrite, Scheduler, StudyFile, Workers, log
from calibray.errors import InputError

if TYPE_CHECKING:
    from calibray.paths import Paths
    from calibray.study import Setup
    from calibray.support.progress import Progress
    from calibray.tracing.convergence import Convergence


def trace(
    study_file: StudyFile,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="HDF5 file to write the paths into.")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Trace again with twice the samples and another seed, and tell what changes; where the samples are "
            "'auto', tell what the last round of rays changed.",
        ),
    ] = False,
    workers: Workers = None,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Find the paths of a study's links and store them as a path program, or check that enough rays were sent out."""
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        from calibray.engines import open_workers
        from calibray.engines.cluster.chunks import stated_chunk_size, trace_in_chunks
        from calibray.engines.cluster.workers import InProcess
        from calibray.reporting import trace_tables as report
        from calibray.study import Study
        from calibray.support.output_files import check_file
        from calibray.tables.text import render

        study = Study.load(study_file)
        _refuse_idleness(out, check)
        if out is not None:
            check_file(out, study.files(), overwrite)
        setup = study.opened()
        links, again = setup.links, check and not study.trace.adaptive
        with open_workers(workers, scheduler) as opened:
            if opened is None and stated_chunk_size(setup) is None:
                paths, found = _traced(setup, out, again, progress)
            else:
                paths, found = trace_in_chunks(setup, opened or InProcess(), check=again, progress=progress)
                if out is not None:
                    paths.save(out)
    typer.echo(render(report.found(paths, links.row, setup.enclosed)))
    if check and study.trace.adaptive:
        typer.echo("\n" + report.rounds(paths.settings, study.fidelity.tolerance_db))
    if found is not None:
        typer.echo("\n" + render(*report.convergence(found, links.row, study.fidelity.tolerance_db)))
    if out is not None:
        typer.echo(f"Written to {out}", err=True)


def _traced(
    setup: Setup, out: Path | None, again: bool, progress: Progress
) -> tuple[Paths, Convergence | None]:
    """Trace all links at once, store the paths, and check them if asked to."""
    from functools import partial

    from calibray.fields import path_loss
    from calibray.support.progress import with_stage
    from calibray.tracing import convergence

    study, links, tracer = setup.study, setup.links, setup.tracer
    if told := tracer.plan(links).announcement(len(links)):
        typer.echo(told, err=True)
    paths = tracer.trace(links, progress)
    if out is not None:
        paths.save(out)
    loss = partial(path_loss, combining=study.objective.combining, bandwidth=study.scene.bandwidth)
    return paths, convergence.check(
        tracer, links, paths, loss, with_stage(progress, "checking")
    ) if again else None


def _refuse_idleness(out: Path | None, check: bool) -> None:
    """Refuse to trace for nothing."""
    if out is None and not check:
        raise InputError("trace: give -o FILE to store the paths, --check to check them, or both")
