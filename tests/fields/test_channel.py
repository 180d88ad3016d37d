"""Channel statistics against closed forms, for synthetic paths of known powers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import synthetic
from calibray.errors import InputError
from calibray.fields import layout, path_loss, path_powers
from calibray.fields.channel import channel_statistics, delay_profile, power_delay_profile, statistics
from calibray.materials import FIELDS
from calibray.paths import Kind, Paths


def direct_paths(link, amplitude, delay, azimuth, links=None):
    """Paths without interactions, of given amplitudes."""
    count = len(link)
    links = links or max(link) + 1
    wavelength = 299792458 / 3e9
    return Paths(
        frequency=3e9,
        materials={},
        tx_position=np.zeros((links, 3)),
        rx_position=np.ones((links, 3)),
        link=np.array(link, dtype=np.int32),
        delay=np.array(delay, dtype=float),
        spreading=np.array(amplitude) * 4 * np.pi / wavelength,
        departure=np.stack([np.full(count, np.pi / 2), azimuth], axis=1),
        arrival=np.stack([np.full(count, np.pi / 2), azimuth], axis=1),
        tx_field=np.tile([[[1.0 + 0j, 0]]], (count, 1, 1)),
        rx_field=np.tile([[[1.0 + 0j, 0]]], (count, 1, 1)),
        first=np.zeros(count + 1, dtype=np.int64),
        kind=np.zeros(0, dtype=np.uint8),
        material=np.zeros(0, dtype=np.int32),
        cos_incidence=np.zeros(0),
        rotation=np.zeros((0, 2)),
        vertex=np.zeros((0, 3), dtype=np.float32),
    )


def test_two_paths_have_the_textbook_spread_and_k_factor():
    paths = direct_paths([0, 0], [3e-5, 1e-5], [1e-6, 2e-6], [0.0, 0.0])
    result = channel_statistics(paths)
    share = 0.9  # 9 : 1 in power
    np.testing.assert_allclose(result.mean_delay, [1.1e-6], rtol=1e-12)
    np.testing.assert_allclose(result.delay_spread, [np.sqrt(share * (1 - share)) * 1e-6], rtol=1e-9)
    np.testing.assert_allclose(result.k_factor_db, [10 * np.log10(9)], rtol=1e-12)


def test_azimuth_spread_of_opposite_and_of_equal_directions():
    paths = direct_paths([0, 0, 1, 1], [1e-5] * 4, [1e-6] * 4, [0.3, 0.3, 0.0, np.pi / 2])
    result = channel_statistics(paths)
    expected = [0.0, np.sqrt(-2 * np.log(np.sqrt(0.5)))]
    np.testing.assert_allclose(result.arrival_spread, expected, atol=1e-7)
    np.testing.assert_allclose(result.departure_spread, expected, atol=1e-7)


def test_a_link_without_a_path_is_nan_and_a_single_path_has_no_spread():
    result = channel_statistics(direct_paths([1], [1e-5], [1e-6], [0.0], links=3))
    assert np.isnan(result.delay_spread[[0, 2]]).all()
    assert np.isnan(result.k_factor_db[[0, 2]]).all()
    assert result.delay_spread[1] == 0
    assert np.isposinf(result.k_factor_db[1])


def test_power_delay_profile_adds_up_to_the_path_gain_and_keeps_the_bins():
    paths = direct_paths([0, 0, 1], [3e-5, 1e-5, 2e-5], [1.5e-6, 2.5e-6, 0.5e-6], [0.0, 0.0, 0.0])
    profile = power_delay_profile(paths, np.array([0, 1e-6, 2e-6, 3e-6]))
    np.testing.assert_allclose(profile, [[0, 9e-10, 1e-10], [4e-10, 0, 0]], rtol=1e-9)
    np.testing.assert_allclose(-10 * np.log10(profile.sum(axis=1)), path_loss(paths), rtol=1e-12)
    with pytest.raises(InputError, match="increasing"):
        power_delay_profile(paths, np.array([1e-6, 0.0]))


def test_derivatives_equal_central_differences():
    paths = synthetic.program(
        [(), (Kind.SPECULAR,), (Kind.DIFFUSE,)] * 5, seed=4, materials=synthetic.LAMBERTIAN
    )
    plan, table = layout(paths), paths.material_table()
    azimuth = [jnp.asarray(angle[plan.order, 1]) for angle in (paths.departure, paths.arrival)]
    edges = jnp.asarray(np.quantile(paths.delay, [0, 0.3, 0.7, 1]))

    def observables(table: jax.Array) -> jax.Array:
        power = path_powers(plan.program, table)
        result = statistics(plan.program, power, *azimuth)
        spread = 1e9 * result.delay_spread  # [ns]
        profile = 1e9 * delay_profile(plan.program, power, edges)
        return jnp.concatenate([spread, result.k_factor_db, result.arrival_spread, profile.ravel()])

    @jax.jit
    def value_and_rate(table: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(observables, (table,), (direction,))

    for field in ("relative_permittivity", "scattering_coefficient"):
        direction = np.zeros_like(table)
        direction[0, FIELDS.index(field)] = 1.0
        step = 1e-4 * direction
        rate = np.asarray(value_and_rate(table, direction)[1])
        above, below = (value_and_rate(point, direction)[0] for point in (table + step, table - step))
        expected = np.asarray(above - below) / 2e-4
        assert (np.abs(rate) > 0).sum() >= 8
        np.testing.assert_allclose(rate, expected, rtol=1e-5, atol=1e-8 * np.abs(expected).max())
