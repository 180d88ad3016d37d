"""What a study says of its links' rows, as the steps of their preparation."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.measurements import Averaging, LinkColumns, Preparation, Track, read_table
from calibray.scenes.scene_file import find_scene

if TYPE_CHECKING:
    from calibray.measurements import Ground, MoveOutside
    from calibray.study.model import Study

_COLUMNS: Final = {"tx", "rx", "value", "quantity", "weight", "std", "tx_power_dbm", "frequency"}
"""Keys of ``[links]`` that are fields of `LinkColumns`."""


def link_columns(study: Study) -> LinkColumns:
    """The columns of a study's table of links.

    Args:
        study: The study.

    Returns:
        The columns, with links grouped as the offset is.

    Raises:
        InputError: Keys of ``[links]`` contradict each other.
    """
    per = study.offset.per if study.offset else None
    return LinkColumns(**study.links.model_dump(include=_COLUMNS), group=per)


def preparation(study: Study) -> Preparation:
    """The steps that a study names.

    Args:
        study: The study.

    Returns:
        The steps.

    Raises:
        InputError: Nothing tells where the scene lies on the globe, or the scene cannot be read.
    """
    links = study.links
    inside = None if links.inside == "keep" else links.inside
    per = study.offset.per if study.offset else None
    groups = [per] if isinstance(per, str) else [*(per or ())]
    track = links.track
    return replace(
        placing(study),
        track=None
        if track is None
        else Track(str(study.track_path), track.time, track.longest_gap, track.clock),
        wide=links.wide,
        where=links.where,
        noise_floor_dbm=links.noise_floor_dbm,
        censored=links.below_floor == "censor",
        averaging=None if links.average is None else Averaging(**links.average.model_dump()),
        keep=list(dict.fromkeys([*groups, *([links.frequency] if links.frequency else [])])),
        inside=inside,
        outside=None if inside is None else _led_outside(study),
    )


def placing(study: Study) -> Preparation:
    """Of these steps those that tell where a row's antennas stand, and leave none out.

    Args:
        study: The study.

    Returns:
        The steps.

    Raises:
        InputError: As for `preparation`.
    """
    links, transmitters = study.links, study.transmitters_path
    return Preparation(
        ground=None if links.heights is None else _ground(study),
        transmitters=None if transmitters is None else read_table(transmitters),
        transmitter=links.transmitter,
        frame=scene_frame(study) if links.position == "geographic" else None,
    )


# What looks into a scene's meshes takes SciPy along; only studies whose rows need that load it.


def _ground(study: Study) -> Ground:
    from calibray.scenes.checks.heights import Overhead

    return Overhead.of(study.scene_source).ground


def _led_outside(study: Study) -> MoveOutside:
    from calibray.scenes.authoring.outlines import led_outside, outlines

    return partial(led_outside, covered=outlines(study.scene_source))


def scene_frame(study: Study) -> Frame:
    """Where a study's scene lies on the globe: as the study says, else as the scene's file does.

    Args:
        study: The study.

    Returns:
        The frame.

    Raises:
        InputError: Neither says it, or the projection is not known.
    """
    frame = known_frame(study)
    if frame is None:
        raise InputError(
            f"{study.path}: links.position = 'geographic': nothing tells where the scene lies; give "
            "scene.origin = [longitude, latitude], and scene.crs if the scene is in a map projection"
        )
    return frame


def known_frame(study: Study) -> Frame | None:
    """Where a study's scene lies on the globe, if anything tells.

    Args:
        study: The study.

    Returns:
        The frame; None if neither the study nor the scene's file says it.

    Raises:
        InputError: The projection is not known.
    """
    origin, crs = study.scene.origin, study.scene.crs
    if crs is not None:
        if origin is None:
            return Frame(crs)
        easting, northing, _ = Frame(crs).to_scene([origin[0]], [origin[1]])[0]
        return Frame(crs, float(easting), float(northing))
    if origin is not None:
        return Frame.local(*origin)
    from calibray.scenes.authoring.scene_folder import read_frame

    return read_frame(find_scene(study.scene_source)[0])
