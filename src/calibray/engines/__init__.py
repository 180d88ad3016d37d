"""Engines: what turns candidates into path loss.

- `Replay` evaluates stored paths: microseconds a candidate, with derivatives; `ReplayCarriers` at several carriers.
- `Retrace` runs the ray tracer anew for every candidate: the cost model of the paper, and replay's rival.
- `Command` asks any external program.
- `Recorded` puts a `Ledger` before one of the latter two, so that no RT call is paid for twice.

A run of one candidate over all links is an RT call. It is counted here, where the engine runs. What a study may say
of an engine stands in `engines.kinds`, light enough to be read with the study; the engines themselves are loaded when
they are used.
"""

from calibray.lazy import lazily

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
    "ReplayCarriers": "calibray.engines.carriers",
    "Retrace": "calibray.engines.retrace",
    "check_candidates": "calibray.engines.protocol",
    "make": "calibray.engines.making",
    "open_executor": "calibray.engines.pool",
    "open_ledger": "calibray.engines.ledger",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = lazily(__name__, _HOMES)
