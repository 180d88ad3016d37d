"""Tracing what the user has: a study, or a scene and links."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import overload

from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.paths import Paths
from calibray.scenes import Scene
from calibray.study.study import Setup, Study
from calibray.support.progress import Progress
from calibray.tracing import default_tracer
from calibray.tracing.protocol import Links
from calibray.tracing.settings import Antenna

Constants = Mapping[str, Material | Mapping[str, object]]


@overload
def trace(
    scene: Study,
    measurements: Measurements | None = None,
    *,
    materials: Mapping[str, Material] | None = None,
    progress: Progress | None = None,
) -> Paths: ...
@overload
def trace(
    scene: str | Path | Scene,
    measurements: Links,
    *,
    frequency: float,
    tx_antenna: Antenna | Mapping[str, object] | None = None,
    rx_antenna: Antenna | Mapping[str, object] | None = None,
    materials: Constants | None = None,
    progress: Progress | None = None,
    **settings: int | bool,
) -> Paths: ...
def trace(
    scene: str | Path | Scene | Study,
    measurements: Links | None = None,
    *,
    frequency: float | None = None,
    tx_antenna: Antenna | Mapping[str, object] | None = None,
    rx_antenna: Antenna | Mapping[str, object] | None = None,
    materials: Constants | None = None,
    progress: Progress | None = None,
    **settings: int | bool,
) -> Paths:
    """Find the paths of every link and compile them.

    Args:
        scene: Mitsuba XML file, `sionna:NAME` for a bundled scene, or a scene already read. Or a study, which says
            itself what its links, carrier, antennas and settings are; its trace is kept between runs.
        measurements: The links; their values and carriers are not looked at (for another carrier, `Paths.at`). With a
            study: links in place of its own.
        frequency: Carrier frequency [Hz].
        tx_antenna: Transmit antenna, as `Antenna` or a mapping with its attributes.
        rx_antenna: Receive antenna.
        materials: Constants in place of the scene's, by material name; with a study, each a `Material`, in place of
            those that its calibration starts from.
        progress: Called with ("tracing", receivers traced, receivers in all) after every launch.
        **settings: The attributes of `TraceSettings`.

    Returns:
        The path program; `links_without_path` tells which links it cannot say anything about.

    Raises:
        InputError: The study, the scene, an antenna, a setting or a position cannot be used, or an argument is missing
            or given although the study says it.
        EngineError: There are more paths than fit into memory.
    """
    said = {"frequency": frequency, "tx_antenna": tx_antenna, "rx_antenna": rx_antenna, **settings}
    if isinstance(scene, Study):
        if given := [name for name, value in said.items() if value is not None]:
            raise InputError(
                f"trace: {given[0]} is given, and said by the study {scene.path} as well; change the study"
            )
        if not isinstance(measurements, Measurements | None):
            raise InputError(
                "trace: measurements of a study must be Measurements; read them, or make them of a table"
            )
        whole = {name: each for name, each in (materials or {}).items() if isinstance(each, Material)}
        if partial := sorted(set(materials or {}) - set(whole)):
            raise InputError(
                f"trace: materials of a study: {partial[0]!r} is no Material; give all its constants as a Material"
            )
        return Setup.open(scene, links=measurements).trace(whole, progress)
    if measurements is None or frequency is None:
        missing = "measurements, the links" if measurements is None else "frequency, the carrier in Hz"
        raise InputError(f"trace: without a study needs {missing}; give it")
    return default_tracer.trace(
        scene,
        measurements,
        frequency=frequency,
        tx_antenna=tx_antenna,
        rx_antenna=rx_antenna,
        materials=materials,
        progress=progress,
        **settings,
    )
