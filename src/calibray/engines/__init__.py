"""Engines: what turns candidates into path loss.

- `Replay` evaluates stored paths: microseconds a candidate, with derivatives.
- `Retrace` runs the ray tracer anew for every candidate: the cost model of the paper, and replay's rival.

A run of one candidate over all links is an RT call. It is counted here, where the engine runs.
"""

from calibray.engines.assembly import ENGINES, make, make_scene, make_tracer, traced_paths
from calibray.engines.protocol import Engine, Progress, check_candidates
from calibray.engines.replay import Replay
from calibray.engines.retrace import Retrace

__all__ = [
    "ENGINES",
    "Engine",
    "Progress",
    "Replay",
    "Retrace",
    "check_candidates",
    "make",
    "make_scene",
    "make_tracer",
    "traced_paths",
]
