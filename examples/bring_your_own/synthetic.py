"""Functions shared by the scripts that make these examples: path amplitudes for planted materials, and fading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from calibray import trace
from calibray.fields import path_gains

ANTENNA = {"pattern": "iso", "polarization": "V"}


def amplitudes(
    scene: Path,
    masts: Sequence[Sequence[float]],
    places: np.ndarray,
    frequency: float,
    planted: Mapping[str, Mapping[str, float]],
    **settings: Any,
) -> list[list[np.ndarray]]:
    """Amplitudes of the paths from every mast to every place.

    Args:
        scene: The scene.
        masts: Transmitter positions [m].
        places: Receiver positions [n, 3], [m].
        frequency: Carrier [Hz].
        planted: Constants that replace those of the scene, by material.
        settings: Settings of the trace.

    Returns:
        The amplitudes of the paths, by mast and place.
    """
    links = SimpleNamespace(
        tx=np.repeat(list(masts), len(places), axis=0), rx=np.tile(places, (len(masts), 1))
    )
    paths = trace(scene, links, frequency=frequency, tx_antenna=ANTENNA, rx_antenna=ANTENNA, **settings)
    truth = dict(paths.materials)
    for name, constants in planted.items():
        truth[name] = replace(truth[name], **constants)
    gains = np.abs(path_gains(paths, truth))
    every = [gains[paths.link == link] for link in range(len(links.tx))]
    return [every[mast * len(places) :][: len(places)] for mast in range(len(masts))]


def sample(gains: np.ndarray, level_dbm: float, rng: np.random.Generator) -> float:
    """Power of one sample [dBm], from the amplitudes of the paths and the level to add.

    Between samples the phone moves by several wavelengths, so the phases of the paths are random.
    """
    field = (gains * np.exp(2j * np.pi * rng.uniform(size=len(gains)))).sum()
    return level_dbm + 20 * np.log10(max(abs(field), 1e-12))
