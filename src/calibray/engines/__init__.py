"""Engines: what turns candidates into path loss.

- `Replay` evaluates stored paths: microseconds a candidate, with derivatives; `ReplayCarriers` at several carriers.
- `Retrace` runs the ray tracer anew for every candidate: the cost model of the paper, and replay's rival.
- `Command` asks any external program.
- `Recorded` puts a `Ledger` before one of the latter two, so that no RT call is paid for twice.

A run of one candidate over all links is an RT call. It is counted here, where the engine runs.
"""

from calibray.engines.assembly import (
    ENGINES,
    compressed_paths,
    make,
    make_parameters,
    make_replay,
    make_scene,
    make_tracer,
    traced_paths,
)
from calibray.engines.carriers import ReplayCarriers
from calibray.engines.command import Command
from calibray.engines.ledger import LEDGER_FILE, Ledger, open_ledger
from calibray.engines.pool import open_executor
from calibray.engines.protocol import Answer, Answering, Differentiable, Engine, Progress, check_candidates
from calibray.engines.recorded import Recorded
from calibray.engines.replay import Replay
from calibray.engines.retrace import Retrace

__all__ = [
    "ENGINES",
    "LEDGER_FILE",
    "Answer",
    "Answering",
    "Command",
    "Differentiable",
    "Engine",
    "Ledger",
    "Progress",
    "Recorded",
    "Replay",
    "ReplayCarriers",
    "Retrace",
    "check_candidates",
    "compressed_paths",
    "make",
    "make_parameters",
    "make_replay",
    "make_scene",
    "make_tracer",
    "open_executor",
    "open_ledger",
    "traced_paths",
]
