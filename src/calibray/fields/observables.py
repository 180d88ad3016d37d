"""Further observables of links besides path loss, as a receiver measures them, with derivatives.

Each is a statistic of a link's paths weighted by their powers. A receiver sees neither paths far below the strongest
nor those below its noise floor. A logistic function of the level in dB, `SOFT_DB` wide, takes the place of that hard
limit, so that derivatives are exact. It changes the weight of paths within some 2 dB of the limit.
"""

from __future__ import annotations

from typing import Final

import jax
import jax.numpy as jnp

from calibray.fields.channel import statistics
from calibray.fields.combining import decibel, path_power
from calibray.fields.effects import Effects, apply_effects
from calibray.fields.material_response import material_response, split_by_step
from calibray.fields.program import GroupedProgram
from calibray.fields.propagation import path_fields
from calibray.measurements.observables import (
    ARRIVAL_SPREAD,
    DELAY_SPREAD,
    DEPARTURE_SPREAD,
    EXCESS_DELAY,
    K_FACTOR,
    ROUND_TRIP,
    Statistic,
)

SOFT_DB: Final = 0.5
"""Width of the limit of a receiver's range [dB]."""


def link_statistics(
    program: GroupedProgram,
    table: jax.Array,
    effects: Effects,
    values: jax.Array,
    azimuths: tuple[jax.Array, jax.Array],
    wanted: tuple[Statistic, ...],
) -> jax.Array:
    """Statistics of every link [K, L]; NaN where a link has no path.

    Args:
        program: The program, with delays.
        table: Material constants [M, 8].
        effects: Effects on the paths.
        values: Values of their parameters [e].
        azimuths: Azimuths of departure and arrival of every path [P], [rad].
        wanted: The K statistics.
    """
    changed = apply_effects(program, effects, values)
    power = path_power(path_fields(changed, split_by_step(changed, material_response(changed, table))))
    return jnp.stack([_statistic(program, power, azimuths, each) for each in wanted])


def _statistic(
    program: GroupedProgram, power: jax.Array, azimuths: tuple[jax.Array, jax.Array], wanted: Statistic
) -> jax.Array:
    link, delay = program.phases
    num_links = program.num_links
    first = jax.ops.segment_min(delay, link, num_links)
    strongest = jax.ops.segment_max(power, link, num_links)
    level_db = -decibel(power)
    seen = jnp.ones_like(power)
    if wanted.dynamic_range_db is not None:
        below = level_db + decibel(strongest)[link]
        seen = seen * jax.nn.sigmoid((below + wanted.dynamic_range_db) / SOFT_DB)
    if wanted.floor_db is not None:
        seen = seen * jax.nn.sigmoid((level_db - wanted.floor_db) / SOFT_DB)
    if wanted.window is not None:
        seen = jnp.where(delay - first[link] <= wanted.window, seen, 0.0)
    # A path of no power is not seen, whatever its level.
    weight = jnp.where(power > 0, power * seen, 0.0)
    found = statistics(program, weight, *azimuths)
    if wanted.kind == DELAY_SPREAD:
        return found.delay_spread
    if wanted.kind == EXCESS_DELAY:
        return found.mean_delay - first
    if wanted.kind == K_FACTOR:
        return found.k_factor_db
    if wanted.kind in (DEPARTURE_SPREAD, ARRIVAL_SPREAD):
        return found.departure_spread if wanted.kind == DEPARTURE_SPREAD else found.arrival_spread
    reached = jnp.isfinite(found.mean_delay)
    if wanted.path == "mean":
        time = found.mean_delay
    elif wanted.path == "first":
        time = jnp.where(reached, first, jnp.nan)
    else:
        is_strongest = power >= strongest[link]
        time = jax.ops.segment_min(jnp.where(is_strongest, delay, jnp.inf), link, num_links)
        time = jnp.where(reached, time, jnp.nan)
    return 2.0 * time if wanted.kind == ROUND_TRIP else time
