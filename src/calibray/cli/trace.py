"""`calibray trace`: trace the links of a study and store the paths, or check whether there are enough rays."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.cli.console import Overwrite, Pool, StudyFile, echo, log, with_groups
from calibray.errors import InputError

if TYPE_CHECKING:
    from calibray.paths import Paths
    from calibray.study import Setup
    from calibray.support.progress import Progress
    from calibray.tracing.convergence import Convergence


@with_groups
def trace(
    study_file: StudyFile,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="HDF5 file for the paths.")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Trace again with twice the samples and another seed, and show the changes. If the samples are "
            "'auto', show the changes caused by the last round of rays.",
        ),
    ] = False,
    *,
    pool: Pool,
    overwrite: Overwrite = False,
) -> None:
    """Trace the links of a study and store the paths, or check whether there are enough rays."""
    from calibray.cli.progress_bars import progress_bars

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


def _trace(
    setup: Setup, out: Path | None, overwrite: bool, trace_again: bool, progress: Progress
) -> tuple[Paths, Convergence | None]:
    """Trace all links together, store the paths, and trace again as a check if requested."""
    from functools import partial

    from calibray.fields import path_loss
    from calibray.support.progress import with_stage
    from calibray.tracing import convergence

    study, links, tracer = setup.study, setup.links, setup.tracer
    if announcement := tracer.plan(links).announcement(len(links)):
        echo(announcement, err=True)
    paths = tracer.trace(links, progress)
    if out is not None:
        paths.save(out, overwrite)
    if not trace_again:
        return paths, None
    loss = partial(path_loss, combining=study.objective.combining, bandwidth=study.scene.bandwidth)
    return paths, convergence.check(tracer, links, paths, loss, with_stage(progress, "checking"))
