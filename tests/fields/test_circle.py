"""Cosine and sine against extended precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibray.fields.trigonometry import circle


def exact(angles):
    extended = angles.astype(np.longdouble)
    return np.array([np.cos(extended), np.sin(extended)])


@pytest.mark.parametrize("largest", [0.8, 10.0, 1e3, 1e6])
def test_within_two_units_in_the_last_place_of_one(largest):
    angles = np.random.default_rng(0).uniform(-largest, largest, 2000)
    np.testing.assert_allclose(circle(angles), exact(angles), rtol=0, atol=2.3e-16)


def test_relative_to_a_small_sine():
    angles = np.geomspace(1e-12, 0.7, 200)
    np.testing.assert_allclose(circle(angles)[1], exact(angles)[1], rtol=3e-16)


def test_at_quarter_turns():
    angles = np.arange(-9, 10) * (np.pi / 2)
    np.testing.assert_allclose(circle(angles), exact(angles), rtol=0, atol=1e-16 + 1e-17)


def test_beyond_a_million_turns_the_angle_s_own_rounding_is_what_counts():
    angles = np.random.default_rng(1).uniform(1e7, 1e9, 500)
    assert (np.abs(np.array(circle(angles)) - exact(angles)) < np.spacing(angles)).all()


def test_derivatives_are_the_other_of_the_two():
    angles = jnp.linspace(-20, 20, 101)
    cosine, sine = circle(angles)
    by_angle = jax.vmap(jax.jacfwd(circle))(angles)
    np.testing.assert_allclose(by_angle, [-sine, cosine], rtol=1e-14)


def test_single_precision_stays_single():
    cosine, sine = circle(jnp.linspace(-100, 100, 500, dtype=jnp.float32))
    assert cosine.dtype == sine.dtype == jnp.float32
    np.testing.assert_allclose(cosine**2 + sine**2, 1, rtol=1e-6)
