"""The default tracer, Sionna RT, which is imported only when a scene is opened; and `trace`, from scene to paths."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any, Final, final

from calibray.errors import InputError
from calibray.paths import Paths
from calibray.scenes import Scene
from calibray.support.progress import Progress
from calibray.tracing.protocol import Links, Tracer
from calibray.tracing.settings import Antenna, TraceSettings, as_antenna


@final
class SionnaFactory:
    """Opens scenes in Sionna RT; a `TracerFactory`."""

    @property
    def versions(self) -> dict[str, str]:
        """Installed versions by package."""
        return {name: version(name) for name in ("sionna-rt", "mitsuba", "drjit")}

    def __call__(
        self,
        scene: Scene,
        frequency: float,
        settings: TraceSettings,
        tx_antenna: Antenna,
        rx_antenna: Antenna,
    ) -> Tracer:
        """Open a scene; see `TracerFactory`. The machine has neither a GPU nor an LLVM for tracing."""
        from calibray.tracing.sionna import Tracer as SionnaTracer

        return SionnaTracer(scene, frequency, settings, tx_antenna, rx_antenna)


SIONNA: Final = SionnaFactory()
"""The tracer that is used unless another one is given."""


def trace(
    scene: Scene,
    links: Links,
    *,
    frequency: float,
    tx_antenna: Antenna | Mapping[str, object] | None = None,
    rx_antenna: Antenna | Mapping[str, object] | None = None,
    progress: Progress | None = None,
    **settings: int | bool,
) -> Paths:
    """Find the paths of every link and compile them; the arguments are those of `calibray.trace` for a scene in memory.

    Raises:
        InputError: An antenna, a setting or a position cannot be used.
        EngineError: The paths do not fit into memory.
    """
    antennas = as_antenna(tx_antenna), as_antenna(rx_antenna)
    return SIONNA(scene, frequency, _trace_settings(settings), *antennas).trace(links, progress)


def _trace_settings(settings: Mapping[str, Any]) -> TraceSettings:
    names = TraceSettings().record()
    unknown = set(settings) - set(names)
    if unknown:
        raise InputError(f"trace: unknown setting {sorted(unknown)[0]!r}; known: {', '.join(names)}")
    return TraceSettings(**settings)
