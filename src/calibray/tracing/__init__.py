"""Tracing: finding the paths of links.

`protocol` defines what any ray tracer must do, `default_tracer` opens Sionna RT, and only the room `tracing.sionna`
imports it. Names are loaded when first used.
"""

from typing import TYPE_CHECKING

from calibray.support.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from calibray.tracing.antennas import AntennaPattern as AntennaPattern
    from calibray.tracing.convergence import Convergence as Convergence
    from calibray.tracing.default_tracer import SIONNA as SIONNA
    from calibray.tracing.gain_table import read_gain_table as read_gain_table
    from calibray.tracing.protocol import EnclosedAntennas as EnclosedAntennas
    from calibray.tracing.protocol import Links as Links
    from calibray.tracing.protocol import Solution as Solution
    from calibray.tracing.protocol import Tracer as Tracer
    from calibray.tracing.protocol import TracerFactory as TracerFactory
    from calibray.tracing.protocol import compile_paths as compile_paths
    from calibray.tracing.protocol import link_positions as link_positions
    from calibray.tracing.settings import Antenna as Antenna
    from calibray.tracing.settings import TraceSettings as TraceSettings
    from calibray.tracing.trace_plan import TracePlan as TracePlan
    from calibray.tracing.trace_plan import plan_trace as plan_trace

__all__, __getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "antennas": "AntennaPattern",
        "convergence": "Convergence",
        "default_tracer": "SIONNA",
        "gain_table": "read_gain_table",
        "protocol": "EnclosedAntennas Links Solution Tracer TracerFactory compile_paths link_positions",
        "settings": "Antenna TraceSettings",
        "trace_plan": "TracePlan plan_trace",
    },
)
