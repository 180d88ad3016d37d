"""Coefficients from tables: their error is known where it is largest, and replay with them equals the formula."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.constants import speed_of_light

import synthetic
from calibray.engines import Replay
from calibray.engines.replay import TABLE_TOLERANCE
from calibray.fields import (
    FINEST,
    layout,
    material_table,
    path_gains,
    path_losses,
    program,
    slab,
    table_intervals,
    tabulation,
)
from calibray.fields.contributions import contributions
from calibray.fields.resolution import COARSEST
from calibray.materials import Material, constants_matrix
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind, take

WAVELENGTH = jnp.asarray(speed_of_light / 28e9)
HARD = {
    "Brewster angle of a loss-free slab": Material(9.0, 0.0, 0.011),
    "resonances of a thick slab": Material(6.3, 0.001, 0.3),
    "grazing incidence on metal": Material(1.0, 1e7, 0.1),
    "total loss": Material(30.0, 50.0, 0.2),
    "air": Material(1.0, 0.0, 0.1),
}
_nodes, _evaluate = jax.jit(tabulation.nodes), jax.jit(tabulation.evaluate)


@pytest.mark.parametrize("mode", [0, tabulation.TRANSMITTED, tabulation.RAW])
@pytest.mark.parametrize("case", HARD)
def test_error_of_a_table_is_bounded_by_what_it_says(case: str, mode: int) -> None:
    cosine = np.concatenate([np.linspace(0, 1, 20_011)[1:], np.geomspace(1e-8, 1e-3, 500)])
    count, constants = len(cosine), constants_matrix({"one": HARD[case]})
    root, table = tabulation.roots(constants, float(WAVELENGTH)), jnp.asarray(constants)
    places = [np.arange(count)]
    lookup = tabulation.make_lookup(
        np.zeros(count, int), np.full(count, mode), cosine, root, places, 512, float
    )
    tables = _nodes(lookup, table, WAVELENGTH)
    found = tabulation.interpolate(tables, lookup.cell[0], lookup.fraction[0])
    zero = jnp.zeros(count, dtype=int)
    exact = _evaluate(
        jnp.asarray(cosine), table, zero, WAVELENGTH, zero + mode == tabulation.TRANSMITTED, zero + mode != 0
    )
    error = max(
        float(jnp.abs(a - b).max())
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True)
    )
    said = float(tabulation.table_error(tables, lookup))
    assert error <= said + 2e-8  # the first node stands at a cosine of `GRAZING`, not at 0
    assert said <= 4 * error + 1e-9  # and is no empty bound


@pytest.fixture(scope="module")
def paths():
    return synthetic.program([sequence for sequence in synthetic.EVERY_KIND if sequence] * 40, seed=5)


@pytest.fixture(scope="module")
def parameters(paths) -> Parameters:
    return Parameters(
        (
            Parameter("walls.relative_permittivity", 1.5, 12.0, start=4.3),
            Parameter("walls.thickness", 0.01, 0.5, start=0.2),
            Parameter("glass.conductivity", 0.0, 1.0, start=0.02),
            Parameter("ground.scattering_coefficient", 0.0, 0.9, start=0.6),
            Parameter("ground.alpha_r", 1.0, 9.0, start=5.6),
        )
    )


def points(parameters: Parameters, count: int = 6) -> np.ndarray:
    unit = np.random.default_rng(2).random((count, len(parameters)))
    return parameters.from_unit(unit)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_replay_with_tables_equals_replay_with_the_formula(paths, parameters, dtype: type) -> None:
    candidates = points(parameters)
    exact = Replay(paths, parameters, dtype=np.float64, tabulate=False)
    tabulated = Replay(paths, parameters, dtype=dtype, tabulate=True)
    np.testing.assert_allclose(tabulated.path_loss(candidates), exact.path_loss(candidates), atol=2e-3)
    loss, slope = tabulated.path_loss_and_jacobian(candidates)
    expected_loss, expected = exact.path_loss_and_jacobian(candidates)
    np.testing.assert_allclose(loss, expected_loss, atol=2e-3)
    scale = np.abs(expected).max(axis=(0, 1))
    assert (np.abs(slope - expected).max(axis=(0, 1)) <= 5e-3 * scale).all()
    assert tabulated.calls == exact.calls == 2 * len(candidates)


def test_a_table_too_coarse_is_refined(paths, parameters) -> None:
    thick = np.array([[11.0, 0.5, 0.0, 0.3, 3.0]])  # resonances as narrow as they come
    high = replace(paths, frequency=28e9)
    engine = Replay(high, parameters, dtype=np.float64, tabulate=True)
    coarse = layout(high, np.float64, 256).program
    table = jnp.asarray(parameters.constants_of(thick, paths.materials)[0])
    found = jax.jit(contributions)(coarse, table)
    assert float(tabulation.table_error(found.coefficients, coarse.coefficients)) > TABLE_TOLERANCE
    exact = Replay(high, parameters, dtype=np.float64, tabulate=False)
    np.testing.assert_allclose(engine.path_loss(thick), exact.path_loss(thick), atol=5e-3)


@pytest.mark.parametrize("case", HARD)
def test_a_row_has_as_many_intervals_as_it_needs(case: str) -> None:
    paths = replace(
        synthetic.program([(Kind.REFRACTION,), (Kind.SPECULAR,)], seed=1),
        frequency=speed_of_light / float(WAVELENGTH),
    )
    paths = replace(paths, materials=dict.fromkeys(paths.materials, HARD[case]))
    table = constants_matrix(paths.materials)
    needed = table_intervals(paths, table[None], 1e-4)
    plans = [
        layout(paths, np.float64, intervals).program for intervals in (needed, np.maximum(needed // 4, 4))
    ]
    said, coarse = (
        float(
            tabulation.table_error(
                _nodes(plan.coefficients, jnp.asarray(table), WAVELENGTH), plan.coefficients
            )
        )
        for plan in plans
    )
    assert said <= 0.2 * 1e-4 or needed.max() == FINEST
    assert coarse > 2 * said or needed.max() == COARSEST
    assert needed.max() < FINEST


def test_large_programs_are_tabulated_without_being_filled_up(monkeypatch: pytest.MonkeyPatch) -> None:
    paths = synthetic.program([q for q in synthetic.EVERY_KIND if 0 < len(q) < 3], seed=6)
    table = jnp.asarray(material_table(paths))[None]
    padded = path_losses(layout(paths, np.float64, 512).program, table)[0]
    monkeypatch.setattr(program, "PADDED", 0)
    plan = layout(paths, np.float64, 512).program
    assert all("r" not in group.signature for group in plan.groups)
    np.testing.assert_allclose(path_losses(plan, table)[0], padded, rtol=1e-12)


def test_formulas_are_evaluated_where_they_stand_and_rows_filled_up_with_ones() -> None:
    reflected = [(Kind.SPECULAR,) * depth for depth in (1, 0, 3, 2, 3)]
    # One of these has nothing before, the other nothing behind the diffuse reflection.
    scattered = [(Kind.SPECULAR, Kind.DIFFUSE), (Kind.DIFFUSE, Kind.REFRACTION)]
    paths = synthetic.program(reflected + scattered, seed=3)
    alone = [path_gains(take(paths, np.array([path])))[0] for path in range(paths.num_paths)]
    np.testing.assert_allclose(path_gains(paths), alone, rtol=1e-12)
    few = take(paths, np.arange(len(reflected)))
    evaluated = layout(few).program.coefficients
    assert isinstance(evaluated, program.Formula)
    assert len(evaluated.cosine) == few.num_interactions == 9


def test_single_precision_holds_metals_at_low_frequencies():
    cosine = jnp.linspace(1e-3, 1, 50)
    copper = (jnp.asarray(1.0), slab.loss_term(jnp.asarray(5.8e7), jnp.asarray(300.0)))  # at 1 MHz, 1e12
    given = (cosine, *copper, jnp.asarray(1e-3), jnp.asarray(300.0))
    single = slab.coefficients(*(jnp.asarray(value, jnp.float32) for value in given), False)
    double = slab.coefficients(*given, False)
    assert single[0][0].dtype == jnp.float32
    np.testing.assert_allclose(single, double, atol=1e-6)
    for real, imaginary in double:
        np.testing.assert_allclose(np.hypot(real, imaginary), 1, atol=2e-3)  # nearly all comes back
