"""From a scene and links to paths: the default tracer, opened when it is needed, and traces kept between runs."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, final

from calibray.errors import InputError
from calibray.materials import Material
from calibray.paths import Paths
from calibray.scenes import Scene, read_scene
from calibray.support.progress import Progress
from calibray.tracing.protocol import Links, Tracer
from calibray.tracing.settings import Antenna, TraceSettings, as_antenna


@final
class SionnaFactory:
    """Sionna RT, imported when the first scene is opened."""

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
        """Open a scene.

        Args:
            scene: The scene, with the materials to trace with.
            frequency: Carrier frequency [Hz].
            settings: The tracer's switches.
            tx_antenna: Transmit antenna.
            rx_antenna: Receive antenna.

        Returns:
            The tracer.

        Raises:
            InputError: This machine has neither a GPU nor an LLVM to trace with, Sionna cannot load the scene, the
                frequency is not a positive number, or an antenna's file of gains cannot be used.
        """
        from calibray.tracing.sionna import Tracer as SionnaTracer

        return SionnaTracer(scene, frequency, settings, tx_antenna, rx_antenna)


SIONNA: Final = SionnaFactory()
"""The tracer that is used where none is named."""


def trace(
    scene: str | Path | Scene,
    links: Links,
    *,
    frequency: float,
    tx_antenna: Antenna | Mapping[str, object] | None = None,
    rx_antenna: Antenna | Mapping[str, object] | None = None,
    materials: Mapping[str, Material | Mapping[str, object]] | None = None,
    progress: Progress | None = None,
    **settings: int | bool,
) -> Paths:
    """Find the paths of every link and compile them.

    Args:
        scene: Mitsuba XML file, `sionna:NAME` for a bundled scene, or a scene already read.
        links: The links; their values and carriers are not looked at (for another carrier, `Paths.at`).
        frequency: Carrier frequency [Hz].
        tx_antenna: Transmit antenna, as `Antenna` or a mapping with its attributes.
        rx_antenna: Receive antenna.
        materials: Constants in place of the scene's, by material name.
        progress: Called with ("tracing", receivers traced, receivers in all) after every launch.
        **settings: The attributes of `TraceSettings`.

    Returns:
        The path program; `links_without_path` tells which links it cannot say anything about.

    Raises:
        InputError: The scene, an antenna, a setting or a position cannot be used.
        EngineError: There are more paths than fit into memory.
    """
    tracer = SIONNA(
        scene if isinstance(scene, Scene) else read_scene(scene, frequency, materials),
        frequency,
        _settings(settings),
        as_antenna(tx_antenna),
        as_antenna(rx_antenna),
    )
    return tracer.trace(links, progress)


def _settings(settings: Mapping[str, Any]) -> TraceSettings:
    unknown = set(settings) - set(TraceSettings().record())
    if unknown:
        raise InputError(
            f"trace: unknown setting {sorted(unknown)[0]!r}; known: {', '.join(TraceSettings().record())}"
        )
    return TraceSettings(**settings)
