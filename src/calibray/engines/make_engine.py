"""Make the engine of a study."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

from calibray.engines.kinds import KINDS
from calibray.engines.ledger.ledger import Ledger
from calibray.engines.ledger.recorded import Recorded
from calibray.engines.problem_fingerprint import fingerprint
from calibray.engines.protocol import Answering, Engine
from calibray.engines.section import Openable
from calibray.errors import InputError
from calibray.paths import Paths
from calibray.support.progress import Progress

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Workers


def make(
    study: Openable,
    name: str | None = None,
    progress: Progress | None = None,
    ledger: str | Path | None = None,
    workers: Workers | None = None,
    *,
    paths: Paths | None = None,
) -> Engine:
    """Make the engine of a study.

    Args:
        study: The study, opened or not.
        name: "replay", "retrace" or "command"; the study's own if None.
        progress: Called after every launch of a trace ("tracing"), or every RT call of a batch ("running").
        ledger: SQLite file that keeps RT calls. Replay does not use it: computing an answer is faster than reading
            one.
        workers: Run the calls of a batch on "command", or keep chunks of links on "replay" (`open_workers`).
        paths: Paths of the study's links for "replay"; traced, or taken from the cache, if None.

    Returns:
        The engine, over all links of the study, held-out links included.

    Raises:
        InputError: The engine is unknown, does not suit the study, or takes no workers; the ledger cannot be used; or
            the study's scene, links or parameters cannot be used.
    """
    opened = study.opened()
    name = opened.engine.name if name is None else name
    if name not in KINDS:
        raise InputError(f"engine {name!r}: must be one of {', '.join(KINDS)}")
    if workers is not None and not (KINDS[name].external or KINDS[name].chunked):
        raise InputError(
            f"engine {name!r} runs in this process; --workers and --scheduler need engine 'command' or 'replay'"
        )
    if name != opened.engine.name:
        opened = opened.replace(engine=name)
    engine = opened.engine.open(opened, paths, progress, workers)
    if ledger is None or not opened.engine.expensive:
        return engine
    # Every expensive kind gives its answers one by one.
    return Recorded(cast(Answering, engine), Ledger(ledger), fingerprint(opened), name, progress)
