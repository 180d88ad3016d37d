"""Cosine and sine against extended precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibray.fields.arithmetic import cosine_and_sine

COUNT = 2000
"""Angles in every test, so that the function is compiled once."""

_compiled = jax.jit(cosine_and_sine)


def exact(angles: np.ndarray) -> np.ndarray:
    extended = angles.astype(np.longdouble)
    return np.array([np.cos(extended), np.sin(extended)])


@pytest.mark.parametrize("largest", [0.8, 10.0, 1e3, 1e6])
def test_within_two_units_in_the_last_place_of_one(largest: float) -> None:
    angles = np.random.default_rng(0).uniform(-largest, largest, COUNT)
    np.testing.assert_allclose(_compiled(angles), exact(angles), rtol=0, atol=2.3e-16)


def test_relative_to_a_small_sine() -> None:
    angles = np.geomspace(1e-12, 0.7, COUNT)
    np.testing.assert_allclose(_compiled(angles)[1], exact(angles)[1], rtol=3e-16)


def test_at_quarter_turns() -> None:
    angles = np.resize(np.arange(-9, 10), COUNT) * (np.pi / 2)
    np.testing.assert_allclose(_compiled(angles), exact(angles), rtol=0, atol=1e-16 + 1e-17)


def test_beyond_a_million_turns_the_rounding_of_the_angle_dominates() -> None:
    angles = np.random.default_rng(1).uniform(1e7, 1e9, COUNT)
    assert (np.abs(np.array(_compiled(angles)) - exact(angles)) < np.spacing(angles)).all()


def test_derivatives_are_minus_the_sine_and_the_cosine() -> None:
    angles = np.linspace(-20, 20, COUNT)
    (cosine, sine), rates = jax.jit(lambda x: jax.jvp(cosine_and_sine, (x,), (jnp.ones_like(x),)))(angles)
    np.testing.assert_allclose(rates, [-sine, cosine], rtol=1e-14)


def test_single_precision_stays_single() -> None:
    cosine, sine = _compiled(jnp.linspace(-100, 100, COUNT, dtype=jnp.float32))
    assert cosine.dtype == sine.dtype == jnp.float32
    np.testing.assert_allclose(cosine**2 + sine**2, 1, rtol=1e-6)
