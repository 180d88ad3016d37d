"""Tracing: finding the paths of links, by default with Sionna RT, which is imported only when a scene is opened.

`protocol` defines the interface of a ray tracer; only the subpackage `tracing.sionna` imports Sionna RT.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Final, final

from calibray.scenes import Scene
from calibray.tracing.protocol import Tracer
from calibray.tracing.settings import Antenna, TraceSettings


@final
class SionnaFactory:
    """A `TracerFactory` that opens scenes in Sionna RT."""

    @property
    def versions(self) -> dict[str, str]:
        """Installed versions, by package."""
        return {name: version(name) for name in ("sionna-rt", "mitsuba", "drjit")}

    def __call__(
        self,
        scene: Scene,
        frequency: float,
        settings: TraceSettings,
        tx_antenna: Antenna,
        rx_antenna: Antenna,
    ) -> Tracer:
        """Open a scene; see `TracerFactory`. The call fails on a machine without a usable GPU or LLVM library."""
        from calibray.tracing.sionna import Tracer as SionnaTracer

        return SionnaTracer(scene, frequency, settings, tx_antenna, rx_antenna)


SIONNA: Final = SionnaFactory()
"""The default tracer."""
