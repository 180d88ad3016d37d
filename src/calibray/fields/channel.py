"""Delays, angles and power delay profiles of links, for any materials.

These quantities are computed from the powers of a link's paths, so they depend as smoothly on the materials as path
loss does. `statistics` and `delay_profile` are pure JAX. Together with `calibray.fields.path_powers`, they can be
differentiated with respect to the materials within `calibray.fields.jax_settings`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.fields.arithmetic import safe_sqrt
from calibray.fields.evaluation import path_powers
from calibray.fields.jax_context import jax_settings
from calibray.fields.program import GroupedProgram, layout
from calibray.materials import Material
from calibray.paths import Paths


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ChannelStatistics:
    """Delay statistics, angular spreads and K-factor of every link; NaN for a link without a path.

    Attributes:
        mean_delay: Mean delay [L], [s].
        delay_spread: Root mean square delay spread [L], [s].
        k_factor_db: Ratio [L], [dB], of the strongest path's power to the total power of all other paths; +inf for a
            single path.
        departure_spread: Azimuth spread at departure [L], [rad].
        arrival_spread: Azimuth spread at arrival [L], [rad].
    """

    mean_delay: jax.Array
    delay_spread: jax.Array
    k_factor_db: jax.Array
    departure_spread: jax.Array
    arrival_spread: jax.Array


@jax_settings()
def channel_statistics(paths: Paths, materials: Mapping[str, Material] | None = None) -> ChannelStatistics:
    """Delay spread, K-factor and angular spreads of every link for given materials.

    Args:
        paths: The path program.
        materials: Material constants by name; the other materials keep the constants of the trace.

    Returns:
        The statistics, as NumPy arrays.

    Raises:
        InputError: A material is unknown.
    """
    plan, table = layout(paths), jax.device_put(paths.material_table(materials))
    azimuths = jax.device_put((paths.departure[plan.order, 1], paths.arrival[plan.order, 1]))
    return jax.tree.map(np.asarray, _statistics(plan.program, table, *azimuths))


@jax.jit
def _statistics(
    program: GroupedProgram, table: jax.Array, departure: jax.Array, arrival: jax.Array
) -> ChannelStatistics:
    return statistics(program, path_powers(program, table), departure, arrival)


def statistics(
    program: GroupedProgram, power: jax.Array, departure: jax.Array, arrival: jax.Array
) -> ChannelStatistics:
    """Statistics of every link, from the powers [P] and azimuths [P], [rad], of its paths."""
    link, delay = program.phases
    of_links = partial(link_mean, power, link=link, num_links=program.num_links)
    return ChannelStatistics(
        mean_delay=of_links(delay),
        delay_spread=delay_spread(power, delay, link, program.num_links),
        k_factor_db=k_factor_db(power, link, program.num_links),
        departure_spread=angular_spread(power, departure, link, program.num_links),
        arrival_spread=angular_spread(power, arrival, link, program.num_links),
    )


def link_mean(weight: jax.Array, value: jax.Array, link: jax.Array, num_links: int) -> jax.Array:
    """Weighted mean [L] of each link's values; NaN if all weights are 0."""
    total = partial(jax.ops.segment_sum, segment_ids=link, num_segments=num_links)
    sums = total(weight)
    return jnp.where(sums > 0, total(weight * value) / jnp.where(sums > 0, sums, 1.0), jnp.nan)


def delay_spread(power: jax.Array, delay: jax.Array, link: jax.Array, num_links: int) -> jax.Array:
    """Root mean square delay spread [L], [s], of every link (ITU-R P.1407-8 eq. 3); NaN without power."""
    mean = link_mean(power, delay, link, num_links)
    # Using delays relative to the mean avoids cancellation between the mean square and the squared mean.
    excess_delay = delay - jnp.nan_to_num(mean)[link]
    variance = link_mean(power, excess_delay**2, link, num_links)
    return jnp.where(jnp.isfinite(mean), safe_sqrt(variance), jnp.nan)


def angular_spread(power: jax.Array, angle: jax.Array, link: jax.Array, num_links: int) -> jax.Array:
    """Circular angular spread [L], [rad], of every link (3GPP TR 38.901 annex A.1); NaN without power."""
    # sqrt(-2 ln |sum P e^{j phi} / sum P|)
    cosine, sine = (link_mean(power, part(angle), link, num_links) for part in (jnp.cos, jnp.sin))
    resultant = jnp.hypot(cosine, sine)
    # Equal powers from opposite directions have a resultant of 0, whose logarithm is infinite.
    spread = safe_sqrt(-2 * jnp.log(jnp.clip(resultant, 1e-300, 1.0)))
    return jnp.where(jnp.isfinite(cosine), spread, jnp.nan)


def k_factor_db(power: jax.Array, link: jax.Array, num_links: int) -> jax.Array:
    """Ratio [L], [dB], of the strongest path's power to the power of all other paths; NaN for links without power."""
    total = jax.ops.segment_sum(power, link, num_links)
    strongest = jax.ops.segment_max(power, link, num_links)
    rest = total - strongest
    ratio = jnp.where(rest > 0, strongest / jnp.where(rest > 0, rest, 1.0), jnp.inf)
    return jnp.where(total > 0, 10 * jnp.log10(ratio), jnp.nan)


@jax_settings()
def power_delay_profile(
    paths: Paths, delays: NDArray[np.float64], materials: Mapping[str, Material] | None = None
) -> NDArray[np.float64]:
    """Power gain of every link in each delay bin.

    Args:
        paths: The path program.
        delays: Edges of the delay bins, increasing [n + 1], [s].
        materials: Material constants by name; the other materials keep the constants of the trace.

    Returns:
        Power gains [L, n]; paths outside all bins are ignored.

    Raises:
        InputError: There are fewer than two edges, the edges do not increase, or a material is unknown.
    """
    edges = np.asarray(delays, dtype=float)
    if edges.ndim != 1 or len(edges) < 2 or not (np.diff(edges) > 0).all():
        raise InputError(
            f"delays: must be two or more increasing bin edges [s], not an array of shape {edges.shape}"
        )
    program = layout(paths).program
    power = path_powers(program, paths.material_table(materials))
    return np.asarray(delay_profile(program, power, jnp.asarray(edges)))


def delay_profile(program: GroupedProgram, power: jax.Array, edges: jax.Array) -> jax.Array:
    """Power gain [L, n] of every link in each delay bin, from path powers [P] and increasing bin edges [n + 1], [s]."""
    link, delay = program.phases
    num_bins = edges.shape[0] - 1
    index = jnp.searchsorted(edges, delay, side="right") - 1
    inside = (index >= 0) & (index < num_bins)
    # Paths outside all bins add 0 to the first bin.
    segment = jnp.where(inside, link * num_bins + index, 0)
    total = jax.ops.segment_sum(jnp.where(inside, power, 0.0), segment, program.num_links * num_bins)
    return total.reshape(program.num_links, num_bins)
