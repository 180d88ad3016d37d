"""The channel sounder of the campaign: from paths to a path loss averaged over noisy snapshots.

The paper's sounder sends a PN9 sequence of 511 chips over 200 MHz and records 100 impulse responses at
every position (section III). Here a snapshot is a power delay profile of 511 taps of 5 ns. Between snapshots, traffic
and swaying masts change the phases of the paths, so that paths within a tap fade. The receiver adds noise.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError

BANDWIDTH: Final = 200e6  # [Hz]; a chip and a tap last 1 / BANDWIDTH
TAPS: Final = 511
SNAPSHOTS: Final = 100
NOISE_DB: Final = -143.0
"""Noise of a tap as a path gain [dB]: -174 dBm/Hz over 200 MHz, noise figure 5 dB, PN9 gain 27 dB, 1 W."""
THRESHOLD: Final = 2.0
"""Taps with a mean power below this multiple of the noise count as empty [1]."""


def sounded_path_loss(
    power: NDArray[np.float64],
    delay: NDArray[np.float64],
    is_diffuse: NDArray[np.bool_],
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Sound one link.

    Specular paths keep their amplitude and change their phase between snapshots. The many diffuse paths of a tap make
    its field complex Gaussian.

    Args:
        power: Power gain of every path [P], [1].
        delay: Delay of every path [P], [s].
        is_diffuse: Whether a path has a diffuse reflection [P].
        rng: Random numbers for phases and noise.

    Returns:
        Path loss of the mean power of the snapshots minus the noise [dB], and the standard deviation of the snapshots,
        (10 / ln 10) std / mean [dB].

    Raises:
        InputError: There is no path, or no tap exceeds the noise.
    """
    noise = 10.0 ** (NOISE_DB / 10.0)
    if not len(power):
        raise InputError("no path reaches the receiver; move it")
    tap = np.floor((delay - delay.min()) * BANDWIDTH).astype(np.int64) % TAPS
    diffuse = np.bincount(tap[is_diffuse], power[is_diffuse], TAPS)
    normal = rng.standard_normal((2, SNAPSHOTS, TAPS))
    field = np.sqrt((diffuse + noise) / 2.0) * (normal[0] + 1j * normal[1])
    # Sorted by delay, so that the result does not depend on the order in which paths were found.
    specular = np.flatnonzero(~is_diffuse)
    specular = specular[np.argsort(delay[specular], kind="stable")]
    phase = rng.uniform(0.0, 2.0 * np.pi, (SNAPSHOTS, len(specular)))
    rays = np.sqrt(power[specular]) * np.exp(1j * phase)
    # Unbuffered, since several paths can fall into one tap.
    np.add.at(field.T, tap[specular], rays.T)
    profile = np.abs(field) ** 2
    occupied = profile.mean(axis=0) > THRESHOLD * noise
    received = profile[:, occupied].sum(axis=1) - noise * occupied.sum()
    mean = received.mean()
    if not mean > 0.0:
        raise InputError(
            f"no tap exceeds {THRESHOLD:g} times the noise of {NOISE_DB:g} dB; move the receiver"
        )
    return float(-10.0 * np.log10(mean)), float(10.0 / np.log(10.0) * received.std(ddof=1) / mean)
