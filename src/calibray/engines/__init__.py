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

from calibray.lazy import lazily

if TYPE_CHECKING:
    from calibray.engines.blocks import Blocks as Blocks
    from calibray.engines.carriers import ReplayCarriers as ReplayCarriers
    from calibray.engines.command import Command as Command
    from calibray.engines.crew import open_crew as open_crew
    from calibray.engines.ledger import LEDGER_FILE as LEDGER_FILE
    from calibray.engines.ledger import Ledger as Ledger
    from calibray.engines.ledger import open_ledger as open_ledger
    from calibray.engines.making import make as make
    from calibray.engines.pool import open_executor as open_executor
    from calibray.engines.protocol import Answer as Answer
    from calibray.engines.protocol import Answering as Answering
    from calibray.engines.protocol import Differentiable as Differentiable
    from calibray.engines.protocol import Engine as Engine
    from calibray.engines.protocol import check_candidates as check_candidates
    from calibray.engines.recorded import Recorded as Recorded
    from calibray.engines.replay import Replay as Replay
    from calibray.engines.retrace import Retrace as Retrace

_HOMES = {
    "LEDGER_FILE": "calibray.engines.ledger",
    "Answer": "calibray.engines.protocol",
    "Answering": "calibray.engines.protocol",
    "Command": "calibray.engines.command",
    "Differentiable": "calibray.engines.protocol",
    "Engine": "calibray.engines.protocol",
    "Ledger": "calibray.engines.ledger",
    "Recorded": "calibray.engines.recorded",
    "Replay": "calibray.engines.replay",
    "Blocks": "calibray.engines.blocks",
    "ReplayCarriers": "calibray.engines.carriers",
    "Retrace": "calibray.engines.retrace",
    "check_candidates": "calibray.engines.protocol",
    "make": "calibray.engines.making",
    "open_crew": "calibray.engines.crew",
    "open_executor": "calibray.engines.pool",
    "open_ledger": "calibray.engines.ledger",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = lazily(__name__, _HOMES)
