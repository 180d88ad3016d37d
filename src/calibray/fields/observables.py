"""Further observables of links besides path loss, as a receiver measures them, with derivatives.

Each is a statistic of a link's paths weighted by their powers. A receiver sees neither paths far below the strongest
nor those below its noise floor. A logistic function of the level in dB, `SOFT_DB` wide, takes the place of that hard
limit, so that derivatives are exact. It changes the weight of paths within some 2 dB of the limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.fields.arithmetic import materialize
from calibray.fields.channel import statistics
from calibray.fields.combining import decibel, path_power
from calibray.fields.effects import Effects, apply_effects
from calibray.fields.evaluation import WIDE, contract
from calibray.fields.jax_context import jax_settings
from calibray.fields.material_response import material_response, response_and_derivatives, split_by_step
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


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["program", "effects", "departure", "arrival"],
    meta_fields=["wanted"],
)
@dataclass(frozen=True)
class Channel:
    """Paths, and what a receiver measures of them.

    Attributes:
        program: The program, with delays.
        effects: Effects on the paths.
        departure: Azimuth of departure of every path [P], [rad].
        arrival: Azimuth of arrival of every path [P], [rad].
        wanted: The K statistics.
    """

    program: GroupedProgram
    effects: Effects
    departure: jax.Array | NDArray[np.float64]
    arrival: jax.Array | NDArray[np.float64]
    wanted: tuple[Statistic, ...]


@jax_settings()
def link_statistics(
    channel: Channel, tables: NDArray[np.floating], values: NDArray[np.floating], count: int
) -> NDArray[np.float64]:
    """Statistics of every link [count, K, L]; NaN where a link has no path.

    Args:
        channel: The paths.
        tables: Material constants [n, M, 8].
        values: Values of the parameters of effects [n, e].
        count: Number of candidates that are evaluated; the function is compiled for n.
    """
    return np.asarray(_values(channel, jnp.asarray(tables), jnp.asarray(values), count))[:count]


@jax_settings()
def link_statistics_and_slopes(
    channel: Channel,
    tables: NDArray[np.floating],
    values: NDArray[np.floating],
    count: int,
    columns: tuple[int, ...],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Statistics, their derivatives by materials [count, K, L, M, columns] and by effects [count, K, L, e]."""
    answers = _values_and_slopes(channel, jnp.asarray(tables), jnp.asarray(values), count, columns)
    found, by_material, by_effect = (np.asarray(answer)[:count] for answer in answers)
    return found, by_material, by_effect


@partial(jax.jit, compiler_options=WIDE)
def _values(channel: Channel, tables: jax.Array, values: jax.Array, count: int) -> jax.Array:
    program, effects = channel.program, channel.effects
    stored = partial(materialize, positive=program.wavelength)

    def evaluate(index: jax.Array, every: jax.Array) -> jax.Array:
        changed = apply_effects(program, effects, values[index])
        responses = split_by_step(changed, stored(material_response(changed, tables[index])))
        power = stored(path_power(path_fields(changed, responses)))
        return every.at[index].set(_measured(channel, power))

    shape = len(tables), len(channel.wanted), program.num_links
    return jax.lax.fori_loop(0, count, evaluate, jnp.zeros(shape))


@partial(jax.jit, static_argnums=4, compiler_options=WIDE)
def _values_and_slopes(
    channel: Channel, tables: jax.Array, values: jax.Array, count: int, columns: tuple[int, ...]
) -> tuple[jax.Array, ...]:
    program, effects, materials = channel.program, channel.effects, tables.shape[1]
    stored = partial(materialize, positive=program.wavelength)
    kinds, num_links = len(channel.wanted), program.num_links

    def evaluate(index: jax.Array, every: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        changed = apply_effects(program, effects, values[index])
        response, derivatives = stored(response_and_derivatives(changed, tables[index], columns))
        responses = split_by_step(changed, response)
        power, pull = jax.vjp(
            lambda responses: stored(path_power(path_fields(changed, responses, stored))), responses
        )
        found, weigh = jax.vjp(partial(_measured, channel), power)
        # Every path belongs to one link: a reverse pass per statistic gives the derivatives of all links.
        ones = jnp.eye(kinds)[:, :, None] * jnp.ones(num_links)
        by_power = stored(jax.vmap(lambda one: weigh(one)[0])(ones))
        by_material = jax.lax.map(
            lambda slope: contract(changed, pull(slope)[0], derivatives, materials), by_power
        )

        by_effect = jnp.zeros((kinds, num_links, values.shape[1]))
        if effects:
            slopes = jax.jacfwd(
                lambda value: path_power(path_fields(apply_effects(program, effects, value), responses))
            )(values[index])  # [P, e]
            sums = partial(jax.ops.segment_sum, segment_ids=program.phases[0], num_segments=num_links)
            by_effect = jax.vmap(lambda slope: sums(slope[:, None] * slopes))(by_power)
        answers = found, by_material, by_effect
        return tuple(array.at[index].set(answer) for array, answer in zip(every, answers, strict=True))

    shapes = (), (materials, len(columns)), (values.shape[1],)
    blank = tuple(jnp.zeros((len(tables), kinds, num_links, *shape)) for shape in shapes)
    return jax.lax.fori_loop(0, count, evaluate, blank)


def _measured(channel: Channel, power: jax.Array) -> jax.Array:
    """The statistics [K, L], from the powers of paths [P]."""
    azimuths = jnp.asarray(channel.departure), jnp.asarray(channel.arrival)
    return jnp.stack([_statistic(channel.program, power, azimuths, each) for each in channel.wanted])


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
