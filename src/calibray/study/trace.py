"""`calibray.trace`: paths of a study, or of a scene and links."""

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
        scene: Mitsuba XML file, `sionna:NAME` for a bundled scene, or a scene already read. Or a study, which states
            its links, carrier, antennas and settings; its trace is cached.
        measurements: The links; their values and carriers do not matter (use `Paths.at` for another carrier). With a
            study, links in place of the study's.
        frequency: Carrier frequency [Hz].
        tx_antenna: Transmit antenna, as `Antenna` or a mapping with its attributes.
        rx_antenna: Receive antenna.
        materials: Constants in place of the scene's, by material name; with a study, each a `Material`, in place of
            the start values.
        progress: Called with ("tracing", receivers traced, receivers in all) after every launch.
        **settings: The attributes of `TraceSettings`.

    Returns:
        The path program; `links_without_path` lists the links that no path reaches.

    Raises:
        InputError: The study, the scene, an antenna, a setting or a position cannot be used; or an argument is missing,
            or given although the study states it.
        EngineError: The paths do not fit into memory.
    """
    if isinstance(scene, Study):
        arguments = {"frequency": frequency, "tx_antenna": tx_antenna, "rx_antenna": rx_antenna, **settings}
        for name, value in arguments.items():
            if value is not None:
                raise InputError(f"trace: the study {scene.path} states {name}; change it there")
        return _trace_study(scene, measurements, materials or {}, progress)
    if measurements is None or frequency is None:
        missing = "measurements, the links" if measurements is None else "frequency, the carrier in Hz"
        raise InputError(f"trace: without a study, give {missing}")
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


def _trace_study(study: Study, links: Links | None, materials: Constants, progress: Progress | None) -> Paths:
    if not isinstance(links, Measurements | None):
        raise InputError(
            "trace: the links of a study must be Measurements; use read_measurements, which takes a table"
        )
    complete: dict[str, Material] = {}
    for name, constants in materials.items():
        if not isinstance(constants, Material):
            raise InputError(
                f"trace: materials of a study: {name!r} is not a Material; give all its constants as a Material"
            )
        complete[name] = constants
    return Setup.open(study, links=links).trace(complete, progress)
