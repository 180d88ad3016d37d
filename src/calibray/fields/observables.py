"""Observables other than path loss, with derivatives, modelled as a receiver measures them.

Each observable is a power-weighted statistic of the paths that a receiver resolves on a link. A receiver of limited
bandwidth resolves taps instead of paths. Taps are samples of the power delay profile, in which the pulse of each path
is spread over a few taps. The receiver does not detect taps that are far below the strongest tap or below the noise
floor. Each of these hard limits is replaced by a logistic function of the level in dB, with scale `SOFT_DB`, so that
derivatives are exact. The logistic function changes the weight of taps within about 2 dB of a limit.
`docs/measurements/observables.md` shows the error of the smooth limit.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.fields.arithmetic import materialize
from calibray.fields.channel import angular_spread, delay_spread, k_factor_db, link_mean
from calibray.fields.effects import Effects, apply_effects
from calibray.fields.jax_context import compiled, jax_settings
from calibray.fields.material_response import material_response, split_by_step
from calibray.fields.program import GroupedProgram
from calibray.fields.propagation import decibel, path_fields, path_power
from calibray.measurements import observables as kinds
from calibray.measurements.observables import Statistic

SOFT_DB: Final = 0.5
"""Scale of the logistic function at the limits of a receiver's range [dB]."""

TAPS: Final = 4
"""Number of taps over which a path is spread: the main lobe of a Hann pulse is four taps wide. All side lobes together
contain 0.05 % of the power, and the highest is 31 dB below the main lobe."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Taps:
    """The T taps of all links; a receiver of limited bandwidth resolves the P paths into these taps.

    Attributes:
        delay: Delay of every tap [T], [s].
        link: Link of every tap [T].
        index: Indices [P, TAPS] of the taps of every path.
        share: Share [P, TAPS] of the path's power in each of these taps.
    """

    delay: NDArray[np.float64]
    link: NDArray[np.int64]
    index: NDArray[np.int64]
    share: NDArray[np.float64]

    @classmethod
    def of(cls, delay: NDArray[np.float64], link: NDArray[np.integer], bandwidth: float) -> Taps:
        """The taps of paths, given their delays [P], [s], their links [P] and the bandwidth [Hz].

        Taps are 1 / bandwidth apart. At this spacing, sampling preserves the power, mean delay and mean square
        delay of the profile, wherever a path lies between two taps.
        """
        # The two taps at or before the path, and the two after it.
        number = np.floor(delay * bandwidth).astype(np.int64)[:, None] + np.arange(TAPS) - TAPS // 2 + 1
        share = hann_pulse(number - delay[:, None] * bandwidth)
        span = int(number.max(initial=0)) + TAPS
        # The tap numbers are at least 1 - TAPS // 2.
        taps, index = np.unique(
            np.asarray(link)[:, None] * (span + TAPS) + number + TAPS, return_inverse=True
        )
        return cls(
            (taps % (span + TAPS) - TAPS) / bandwidth,
            taps // (span + TAPS),
            index.reshape(number.shape),
            share / share.sum(axis=1, keepdims=True),
        )

    def power(self, power: jax.Array) -> jax.Array:
        """Power of every tap [T] from the power of every path [P]."""
        spread = power[:, None] * self.share
        return jax.ops.segment_sum(spread.ravel(), jnp.asarray(self.index).ravel(), len(self.delay))

    def of_paths(self, seen: jax.Array) -> jax.Array:
        """Detected share of every path's power [P], from the detected share of every tap [T]."""
        return jnp.sum(seen[jnp.asarray(self.index)] * self.share, axis=1)


def hann_pulse(time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pulse power, at times in units of 1 / bandwidth, for a receiver that applies a Hann window to its spectrum.

    The root mean square width of the pulse is 1 / (sqrt(3) bandwidth). Outside the main lobe, the power is set to 0.
    """
    inside = np.abs(time) < TAPS / 2
    near = np.isclose(np.abs(time), 1.0)
    divisor = np.where(near, 1.0, 1.0 - time**2)
    return np.where(inside, np.where(near, 0.5, np.sinc(time) / divisor) ** 2, 0.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Channel:
    """Paths, and the statistics that a receiver measures, as functions of d parameters.

    Attributes:
        program: The program, with delays.
        effects: Effects on the paths.
        base: Constants of the materials before calibration [M, 8].
        departure: Zenith and azimuth angles [P, 2], [rad], of departure of every path.
        arrival: Zenith and azimuth angles [P, 2], [rad], of arrival of every path.
        taps: The taps for each bandwidth that the statistics use.
        cells: For every material parameter: its index, and the row and column of its constant in `base`.
        of_effects: Indices of the parameters of effects.
        wanted: The K statistics to compute.
    """

    program: GroupedProgram
    effects: Effects
    base: NDArray[np.float64]
    departure: NDArray[np.float64]
    arrival: NDArray[np.float64]
    cells: tuple[tuple[int, int, int], ...] = field(metadata={"static": True})
    of_effects: tuple[int, ...] = field(metadata={"static": True})
    taps: tuple[Taps, ...] = ()
    wanted: tuple[Statistic, ...] = field(default=(), metadata={"static": True})

    @jax_settings()
    def measuring(self, wanted: tuple[Statistic, ...]) -> Channel:
        """The same channel with other statistics."""
        link, delay = (np.asarray(part) for part in self.program.phases)
        taps = tuple(Taps.of(delay, link, bandwidth) for bandwidth in _bandwidths(wanted))
        return jax.device_put(replace(self, taps=taps, wanted=wanted))


def _bandwidths(wanted: tuple[Statistic, ...]) -> list[float]:
    return sorted({each.bandwidth for each in wanted if each.bandwidth is not None})


@jax_settings()
def link_responses(
    channel: Channel, values: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Path loss from the sum of powers [count, L], [dB], and statistics [count, K, L]; NaN for a link without a path.

    Only the first `count` rows of the parameter values [n, d] are evaluated; the function is compiled for n rows.
    """
    loss, observed = _responses(channel, jax.device_put(values), count)
    return np.asarray(loss)[:count], np.asarray(observed)[:count]


@jax_settings()
def link_responses_and_slopes(
    channel: Channel, values: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], ...]:
    """Path loss, statistics, and their derivatives with respect to the parameters, [count, L, d] and [count, K, L, d].

    Derivatives of a statistic are NaN where the statistic is not finite.
    """
    answers = _responses_and_slopes(channel, jax.device_put(values), count)
    loss, observed, loss_slope, slope = (np.asarray(answer)[:count] for answer in answers)
    return loss, observed, loss_slope, np.where(np.isfinite(observed)[..., None], slope, np.nan)


@compiled
def _responses(channel: Channel, values: jax.Array, count: int) -> tuple[jax.Array, ...]:
    def evaluate(index: jax.Array, every: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        answers = _response(channel, values[index])
        return tuple(array.at[index].set(answer) for array, answer in zip(every, answers, strict=True))

    return jax.lax.fori_loop(0, count, evaluate, _blank(channel, len(values)))


@compiled
def _responses_and_slopes(channel: Channel, values: jax.Array, count: int) -> tuple[jax.Array, ...]:
    directions = jnp.eye(values.shape[1])

    def evaluate(index: jax.Array, every: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        def push(direction: jax.Array) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
            return jax.jvp(partial(_response, channel), (values[index],), (direction,))

        # With many statistics and few parameters, forward mode is faster to compile and to run.
        found, slopes = jax.vmap(push, out_axes=(None, -1))(directions)
        answers = *found, *slopes
        return tuple(array.at[index].set(answer) for array, answer in zip(every, answers, strict=True))

    blank = _blank(channel, len(values))
    slopes = tuple(jnp.zeros((*array.shape, values.shape[1])) for array in blank)
    return jax.lax.fori_loop(0, count, evaluate, (*blank, *slopes))


def _blank(channel: Channel, size: int) -> tuple[jax.Array, jax.Array]:
    num_links = channel.program.num_links
    return jnp.zeros((size, num_links)), jnp.zeros((size, len(channel.wanted), num_links))


def _response(channel: Channel, values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Path loss [L] and the statistics [K, L] for parameter values [d]."""
    program, table = channel.program, jnp.asarray(channel.base)
    stored = partial(materialize, positive=program.wavelength)
    if channel.cells:
        index, rows, columns = np.array(channel.cells).T
        table = table.at[rows, columns].set(values[index])
    changed = apply_effects(program, channel.effects, values[jnp.array(channel.of_effects, dtype=int)])
    responses = split_by_step(changed, stored(material_response(changed, table)))
    power = stored(path_power(path_fields(changed, responses)))
    link, _ = program.phases
    loss = decibel(jax.ops.segment_sum(power, link, program.num_links))
    every = [_statistic(channel, power, each) for each in channel.wanted]
    return loss, jnp.stack(every) if every else jnp.zeros((0, program.num_links))


def _statistic(channel: Channel, power: jax.Array, wanted: Statistic) -> jax.Array:
    """One statistic [L] of every link, from the powers [P] of the paths."""
    num_links, (link, delay) = channel.program.num_links, channel.program.phases
    taps, tap_delay, tap_link, tap_power = None, delay, link, power
    if wanted.bandwidth is not None:
        taps = channel.taps[_bandwidths(channel.wanted).index(wanted.bandwidth)]
        tap_delay, tap_link, tap_power = jnp.asarray(taps.delay), jnp.asarray(taps.link), taps.power(power)
    seen = _seen(tap_power, tap_link, num_links, wanted)
    # A tap counts as detected if its detected share is at least one half.
    detected = jnp.where((tap_power > 0) & (seen >= 0.5), tap_delay, jnp.inf)
    first = jax.ops.segment_min(detected, tap_link, num_links)
    if wanted.window is not None:
        seen = jnp.where(tap_delay - first[tap_link] <= wanted.window + kinds.ROUNDING, seen, 0.0)
    weight = tap_power * seen
    if wanted.kind == kinds.DELAY_SPREAD:
        return delay_spread(weight, tap_delay, tap_link, num_links)
    if wanted.kind == kinds.EXCESS_DELAY:
        mean = link_mean(weight, tap_delay, tap_link, num_links)
        return jnp.where(jnp.isfinite(first), mean - first, jnp.nan)
    if wanted.kind == kinds.K_FACTOR:
        return k_factor_db(weight, tap_link, num_links)
    if wanted.kind == kinds.DELAY_BIN:
        return _share(weight, tap_delay - first[tap_link], tap_link, num_links, wanted)
    of_paths = seen if taps is None else taps.of_paths(seen)
    path_weight = power * of_paths
    if wanted.kind in kinds.FLIGHTS:
        time = _flight(path_weight, of_paths, delay, link, num_links, wanted)
        return 2.0 * time if wanted.kind == kinds.ROUND_TRIP else time
    angle = jnp.asarray(_angles(channel, wanted.kind))
    if wanted.kind in kinds.SECTORS:
        start, _ = wanted.bin
        # Angles are measured from the start of the sector, because the sector may contain the jump from pi to -pi.
        turned = (angle - start) % (2 * np.pi) + start
        return _share(path_weight, turned, link, num_links, wanted)
    return angular_spread(path_weight, angle, link, num_links)


def _seen(power: jax.Array, link: jax.Array, num_links: int, wanted: Statistic) -> jax.Array:
    """Detected share [T] of every tap's power, as a function of the tap's level."""
    level_db, seen = -decibel(power), jnp.ones_like(power)
    if wanted.dynamic_range_db is not None:
        strongest = jax.ops.segment_max(power, link, num_links)
        # Level relative to the link's strongest tap; `decibel` is a loss.
        below = level_db + decibel(strongest)[link]
        seen = seen * jax.nn.sigmoid((below + wanted.dynamic_range_db) / SOFT_DB)
    if wanted.floor_db is not None:
        seen = seen * jax.nn.sigmoid((level_db - wanted.floor_db) / SOFT_DB)
    # A tap without power is never detected.
    return jnp.where(power > 0, seen, 0.0)


def _share(
    weight: jax.Array, value: jax.Array, link: jax.Array, num_links: int, wanted: Statistic
) -> jax.Array:
    """Share [L], [dB], of each link's weight with values in the bin; minus the dynamic range if the bin is empty."""
    low, high = wanted.bin
    share = link_mean(weight, ((value >= low) & (value < high)).astype(weight.dtype), link, num_links)
    range_db = kinds.SHARE_RANGE_DB if wanted.dynamic_range_db is None else wanted.dynamic_range_db
    # The added term is the power at the lower end of the dynamic range. This term keeps the level of an empty bin
    # finite.
    return 10 * jnp.log10(share + 10 ** (-range_db / 10))


def _flight(
    weight: jax.Array, seen: jax.Array, delay: jax.Array, link: jax.Array, num_links: int, wanted: Statistic
) -> jax.Array:
    """Time of flight [L], [s], of every link: mean over all paths, or over one path and those not resolved from it."""
    if wanted.path == "mean":
        return link_mean(weight, delay, link, num_links)
    if wanted.path == "first":
        chosen = (weight > 0) & (seen >= 0.5)
    else:
        chosen = (weight > 0) & (weight >= jax.ops.segment_max(weight, link, num_links)[link])
    start = jax.ops.segment_min(jnp.where(chosen, delay, jnp.inf), link, num_links)
    if wanted.bandwidth is None:
        return jnp.where(jnp.isfinite(start), start, jnp.nan)
    # A path within 1 / bandwidth of the chosen path is not resolved from it. The weight of this path decreases as a
    # raised cosine.
    apart = (delay - start[link]) * wanted.bandwidth
    unresolved = jnp.where(jnp.abs(apart) < 1.0, 0.5 * (1 + jnp.cos(jnp.pi * apart)), 0.0)
    return link_mean(weight * unresolved, delay, link, num_links)


def _angles(channel: Channel, kind: str) -> NDArray[np.float64]:
    """Zenith or azimuth angle [P], [rad], of every path at one end."""
    at_departure = kind in (kinds.DEPARTURE_SPREAD, kinds.DEPARTURE_ELEVATION, kinds.DEPARTURE_SECTOR)
    angles = channel.departure if at_departure else channel.arrival
    return angles[:, 0 if kind in (kinds.DEPARTURE_ELEVATION, kinds.ARRIVAL_ELEVATION) else 1]
