"""From an opened study to what it runs on."""

from __future__ import annotations

from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING, cast

from calibray.engines.fingerprint import fingerprint
from calibray.engines.kinds import KINDS
from calibray.engines.ledger.ledger import Ledger
from calibray.engines.ledger.recorded import Recorded
from calibray.engines.protocol import Answering, Engine
from calibray.engines.section import EngineSection
from calibray.errors import InputError
from calibray.paths import Paths
from calibray.support.progress import Progress

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Crew
    from calibray.study.model import Study
    from calibray.study.setup import Setup


def make(
    study: Study | Setup,
    name: str | None = None,
    progress: Progress | None = None,
    ledger: str | Path | None = None,
    executor: Executor | Crew | None = None,
    *,
    paths: Paths | None = None,
) -> Engine:
    """The engine of a study.

    Args:
        study: The study, opened or not.
        name: "replay", "retrace" or "command"; the study's own if None.
        progress: Called after every launch of a trace ("tracing"), or every RT call of a batch ("running").
        ledger: SQLite file to keep RT calls in. Replay has no use for it: finding an answer there takes longer
            than computing it.
        executor: What runs the calls of a batch, for "command" (`open_executor`); where blocks of links live, for
            "replay" (`open_crew`).
        paths: Paths of the study's links for "replay"; traced, or taken from the cache, if None.

    Returns:
        The engine, over all links of the study, those held out included.

    Raises:
        InputError: The engine is unknown, or does not fit the study or the executor; the ledger cannot be used; or
            the study's scene, links or parameters cannot be used.
    """
    setup = study.opened()
    name = setup.study.engine.name if name is None else name
    if name not in KINDS:
        raise InputError(f"engine {name!r}: must be one of {', '.join(KINDS)}")
    if executor is not None and not _fits(KINDS[name], executor):
        raise InputError(
            f"engine {name!r} runs in this process; --workers and --scheduler need engine 'command' or 'replay'"
        )
    if name != setup.study.engine.name:
        setup = setup.replace(engine=name)
    section = setup.study.engine
    engine = section.open(setup, paths, progress, executor)
    if ledger is None or not section.dear:
        return engine
    # Kinds whose calls are dear answer one by one.
    return Recorded(cast(Answering, engine), Ledger(ledger), fingerprint(setup), name, progress)


def _fits(kind: type[EngineSection], executor: Executor | Crew) -> bool:
    return kind.external if isinstance(executor, Executor) else kind.parted
