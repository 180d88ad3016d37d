"""Engines compute the path loss of links for candidate parameter values.

- `Replay` evaluates stored paths, with derivatives, in microseconds to milliseconds per candidate.
- `ReplayCarriers` evaluates stored paths at several carriers.
- `ChunkedReplay` replays links in chunks, in this process or on workers, and can return sums over links instead of one
  value per link.
- `Retrace` runs the ray tracer again for every candidate, as the paper does.
- `Command` calls an external program.
- `Recorded` stores the answers of `Retrace` or `Command` in a `Ledger`, so that no RT call is repeated.

An RT call is one run of an engine that evaluates one candidate for all links. Every engine counts its own calls.
`engines.kinds` defines the engine sections of a study file and is imported whenever a study is read. JAX is loaded on
first use.
"""

from typing import TYPE_CHECKING

from calibray.support.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from calibray.engines.cluster.chunks import ChunkedReplay as ChunkedReplay
    from calibray.engines.cluster.workers import InProcess as InProcess
    from calibray.engines.cluster.workers import Workers as Workers
    from calibray.engines.cluster.workers import open_workers as open_workers
    from calibray.engines.compression import compress as compress
    from calibray.engines.external.exchange import Request as Request
    from calibray.engines.kinds.command import Command as Command
    from calibray.engines.kinds.retrace import Retrace as Retrace
    from calibray.engines.ledger.database import LedgerEntry as LedgerEntry
    from calibray.engines.ledger.database import key as key
    from calibray.engines.ledger.ledger import LEDGER_FILE as LEDGER_FILE
    from calibray.engines.ledger.ledger import Ledger as Ledger
    from calibray.engines.ledger.ledger import open_ledger as open_ledger
    from calibray.engines.ledger.recorded import Recorded as Recorded
    from calibray.engines.make_engine import fingerprint as fingerprint
    from calibray.engines.make_engine import make as make
    from calibray.engines.protocol import PATH_LOSS as PATH_LOSS
    from calibray.engines.protocol import Answer as Answer
    from calibray.engines.protocol import Answering as Answering
    from calibray.engines.protocol import Chunked as Chunked
    from calibray.engines.protocol import Differentiable as Differentiable
    from calibray.engines.protocol import Engine as Engine
    from calibray.engines.protocol import Observable as Observable
    from calibray.engines.protocol import check_candidates as check_candidates
    from calibray.engines.replay import Replay as Replay
    from calibray.engines.replay import ReplayCarriers as ReplayCarriers
    from calibray.engines.section import OpenedStudy as OpenedStudy
    from calibray.engines.section import RadioSettings as RadioSettings

__all__, __getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "cluster.chunks": "ChunkedReplay",
        "cluster.workers": "InProcess Workers open_workers",
        "compression": "compress",
        "kinds.command": "Command",
        "external.exchange": "Request",
        "ledger.database": "LedgerEntry key",
        "ledger.ledger": "LEDGER_FILE Ledger open_ledger",
        "ledger.recorded": "Recorded",
        "make_engine": "fingerprint make",
        "protocol": "PATH_LOSS Answer Answering Chunked Differentiable Engine Observable check_candidates",
        "replay": "Replay ReplayCarriers",
        "kinds.retrace": "Retrace",
        "section": "OpenedStudy RadioSettings",
    },
)
