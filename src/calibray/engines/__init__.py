"""Engines: what turns candidates into path loss.

- `Replay` evaluates stored paths: microseconds a candidate, with derivatives; `ReplayCarriers` at several carriers.
- `Blocks` replays links in blocks, which live here or on the workers of a cluster; only sums come back.
- `Retrace` runs the ray tracer anew for every candidate: the cost model of the paper, and replay's rival.
- `Command` asks any external program.
- `Recorded` puts a `Ledger` before one of the latter two, so that no RT call is paid for twice.

A run of one candidate over all links is an RT call. It is counted here, where the engine runs. What a study may say
of an engine stands in `engines.kinds`, light enough to be read with the study; the engines themselves are loaded when
they are used.
"""

from typing import TYPE_CHECKING

from calibray.support.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from calibray.engines.cluster.blocks import Blocks as Blocks
    from calibray.engines.cluster.executors import open_executor as open_executor
    from calibray.engines.cluster.workers import open_crew as open_crew
    from calibray.engines.external.command import Command as Command
    from calibray.engines.ledger.ledger import LEDGER_FILE as LEDGER_FILE
    from calibray.engines.ledger.ledger import Ledger as Ledger
    from calibray.engines.ledger.ledger import open_ledger as open_ledger
    from calibray.engines.ledger.recorded import Recorded as Recorded
    from calibray.engines.make_engine import make as make
    from calibray.engines.multi_carrier import ReplayCarriers as ReplayCarriers
    from calibray.engines.protocol import Answer as Answer
    from calibray.engines.protocol import Answering as Answering
    from calibray.engines.protocol import Differentiable as Differentiable
    from calibray.engines.protocol import Engine as Engine
    from calibray.engines.protocol import check_candidates as check_candidates
    from calibray.engines.replay import Replay as Replay
    from calibray.engines.retrace import Retrace as Retrace

_HOMES = {
    "LEDGER_FILE": "calibray.engines.ledger.ledger",
    "Answer": "calibray.engines.protocol",
    "Answering": "calibray.engines.protocol",
    "Command": "calibray.engines.external.command",
    "Differentiable": "calibray.engines.protocol",
    "Engine": "calibray.engines.protocol",
    "Ledger": "calibray.engines.ledger.ledger",
    "Recorded": "calibray.engines.ledger.recorded",
    "Replay": "calibray.engines.replay",
    "Blocks": "calibray.engines.cluster.blocks",
    "ReplayCarriers": "calibray.engines.multi_carrier",
    "Retrace": "calibray.engines.retrace",
    "check_candidates": "calibray.engines.protocol",
    "make": "calibray.engines.make_engine",
    "open_crew": "calibray.engines.cluster.workers",
    "open_executor": "calibray.engines.cluster.executors",
    "open_ledger": "calibray.engines.ledger.ledger",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = lazy_attributes(__name__, _HOMES)
