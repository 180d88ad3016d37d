"""Coefficients from tables: their error is bounded where it is largest, and replay with them equals the formula."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.constants import speed_of_light

import reference_fields
import synthetic
from calibray.engines import Replay
from calibray.engines.replay import Computation
from calibray.fields import FINEST, layout, path_losses, program, table_intervals
from calibray.fields.coefficient_tables import (
    COARSEST,
    fill_tables,
    interpolate,
    spacing_roots,
    table_error,
    table_layout,
)
from calibray.fields.slab import Mode, coefficients, coefficients_of_materials, loss_term
from calibray.materials import Material, constants_matrix
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind, Paths

FREQUENCY = 28e9
WAVELENGTH = speed_of_light / FREQUENCY
TOLERANCE = 1e-4
DIFFICULT = {
    "Brewster angle of a loss-free slab": Material(9.0, 0.0, 0.011),
    "resonances of a thick slab": Material(6.3, 0.001, 0.3),
    "grazing incidence on metal": Material(1.0, 1e7, 0.1),
    "total loss": Material(30.0, 50.0, 0.2),
    "air": Material(1.0, 0.0, 0.1),
    "grazing incidence on smoke": Material(1.0, 0.001, 0.02),
}
INTERVALS = {"grazing incidence on smoke": 64}
_fill_tables, _exact = jax.jit(fill_tables), jax.jit(coefficients_of_materials)


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("case", DIFFICULT)
def test_error_of_a_table_is_within_its_bound(case: str, mode: Mode) -> None:
    cosine = np.concatenate([np.linspace(0, 1, 20_011)[1:], np.geomspace(1e-8, 1e-3, 500)])
    count, constants = len(cosine), constants_matrix({"one": DIFFICULT[case]})
    material, modes = np.zeros(count, dtype=int), np.full(count, mode)
    positions = table_layout(
        (material, modes, cosine),
        spacing_roots(constants, WAVELENGTH),
        [np.arange(count)],
        INTERVALS.get(case, 512),
        float,
    )
    wavelength, table = jnp.asarray(WAVELENGTH), jnp.asarray(constants)
    tables = _fill_tables(positions, table, wavelength)
    interpolated = interpolate(tables, positions.cell[0], positions.fraction[0])
    exact = _exact(cosine, table, material, wavelength, modes == Mode.TRANSMISSION, modes != Mode.REFLECTION)
    error = max(
        float(jnp.abs(a - b).max())
        for a, b in zip(jax.tree.leaves(interpolated), jax.tree.leaves(exact), strict=True)
    )
    bound = float(table_error(tables, positions, 1)[0, mode])
    assert error <= bound + 2e-8  # the first node is just above grazing incidence
    assert bound <= 4 * error + 1e-9  # and the bound is not empty


def interpolation_error(material: Material, mode: Mode, intervals: int) -> float:
    """Largest error of cubics half-way between nodes that are even in the (square or sixth) root of the cosine."""
    root = 6 if material.conductivity > 1e6 else 2

    def value(position: np.ndarray) -> np.ndarray:
        # coefficients are even functions of the root of the cosine
        cosines = np.maximum((np.abs(position) / intervals) ** root, 1e-9)
        pairs = [reference_fields.slab(cosine, material, FREQUENCY)[mode == 1] for cosine in cosines]
        return np.array(pairs)

    node = np.arange(intervals)
    before, low, high, after = (value(node + step) for step in (-1, 0, 1, 2))
    gap = value(node + 0.5) - (9 / 16 * (low + high) - 1 / 16 * (before + after))
    gap = gap[: intervals - 1]  # the last interval has no node behind it
    return float(max(np.abs(gap.real).max(), np.abs(gap.imag).max()))


@pytest.mark.parametrize("case", DIFFICULT)
def test_a_row_has_as_many_intervals_as_it_needs(case: str) -> None:
    paths = synthetic.program([(Kind.REFRACTION,), (Kind.SPECULAR,)], seed=1, frequency=FREQUENCY)
    paths = replace(paths, materials={"one": DIFFICULT[case]}, material=np.zeros_like(paths.material))
    needed = table_intervals(paths, paths.material_table()[None], TOLERANCE)
    assert needed.shape == (1, len(Mode))
    assert needed[0, Mode.FULL_REFLECTION] == 0  # nothing is scattered
    for mode in (Mode.REFLECTION, Mode.TRANSMISSION):
        intervals = int(needed[0, mode])
        assert COARSEST <= intervals < FINEST
        assert interpolation_error(DIFFICULT[case], mode, intervals) <= 0.1 * TOLERANCE + 1e-9
        if intervals > COARSEST:
            assert interpolation_error(DIFFICULT[case], mode, intervals // 2) > 0.1 * TOLERANCE - 1e-9


@pytest.fixture(scope="module")
def paths() -> Paths:
    """Every kind of interaction that looks coefficients up."""
    sequences = [(Kind.SPECULAR, Kind.REFRACTION), (Kind.DIFFUSE,), (Kind.DIFFRACTION,)]
    return synthetic.program(sequences * 10, seed=5, materials=synthetic.LAMBERTIAN)


@pytest.fixture(scope="module")
def parameters() -> Parameters:
    return Parameters(
        (
            Parameter("walls.relative_permittivity", 1.5, 12.0, start=4.3),
            Parameter("walls.thickness", 0.01, 0.5, start=0.2),
            Parameter("glass.conductivity", 0.0, 1.0, start=0.02),
            Parameter("ground.scattering_coefficient", 0.0, 0.9, start=0.6),
        )
    )


@pytest.fixture(scope="module")
def candidates(parameters: Parameters) -> np.ndarray:
    return parameters.from_unit(np.random.default_rng(2).random((6, len(parameters))))


@pytest.fixture(scope="module")
def exact(paths: Paths, parameters: Parameters, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Path loss and derivatives by the formula."""
    return Replay(paths, parameters, computation=Computation(np.float64, False)).path_loss_and_jacobian(
        candidates
    )


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_replay_with_tables_equals_replay_with_the_formula(
    paths: Paths, parameters: Parameters, candidates: np.ndarray, exact: tuple, dtype: type
) -> None:
    engine = Replay(paths, parameters, computation=Computation(dtype, True))
    loss, slope = engine.path_loss_and_jacobian(candidates)
    np.testing.assert_allclose(loss, exact[0], atol=2e-3)
    scale = np.abs(exact[1]).max(axis=(0, 1))
    assert (np.abs(slope - exact[1]).max(axis=(0, 1)) <= 5e-3 * scale).all()
    if dtype == np.float64:  # to save a compilation
        np.testing.assert_allclose(engine.path_loss(candidates), loss, atol=1e-9)


def test_a_table_that_is_too_coarse_is_refined(parameters: Parameters) -> None:
    paths = synthetic.program(
        [(Kind.SPECULAR,), (Kind.REFRACTION,)] * 20,
        seed=5,
        materials=synthetic.LAMBERTIAN,
        frequency=FREQUENCY,
    )
    thick = np.array([[11.0, 0.5, 0.0, 0.3]])  # the narrowest resonances
    engine = Replay(paths, parameters, computation=Computation(np.float64, True))
    _, error = path_losses(
        layout(paths, np.float64, 256).program, parameters.constants_of(thick, paths.materials)
    )
    assert error.max() > TOLERANCE
    exact = Replay(paths, parameters, computation=Computation(np.float64, False))
    np.testing.assert_allclose(engine.path_loss(thick), exact.path_loss(thick), atol=5e-3)


def test_only_tables_that_are_too_coarse_are_refined() -> None:
    """A candidate with one thick material does not slow down all others by finer tables of every material."""
    sequences = [(Kind.SPECULAR,), (Kind.REFRACTION,)] * 20
    paths = synthetic.program(sequences, seed=5, materials=synthetic.LAMBERTIAN, frequency=FREQUENCY)
    parameters = Parameters((Parameter("glass.thickness", 0.005, 0.02, start=0.009),))
    tables = Computation(np.float64, True)
    engine = Replay(paths, parameters, computation=tables)
    exact = Replay(paths, parameters, computation=Computation(np.float64, False))
    before, glass = engine._intervals, list(paths.materials).index("glass")
    thick = np.array([[0.5]])  # far beyond the bounds from which the tables were made
    np.testing.assert_allclose(engine.path_loss(thick), exact.path_loss(thick), atol=5e-3)
    assert before is not None
    assert engine._intervals is not None
    finer = engine._intervals > before
    assert finer[glass].any()
    assert not np.delete(finer, glass, axis=0).any()
    # Within a batch, candidates before it keep the coarse tables, and those from it on use the refined ones.
    coarse, refined = (Replay(paths, parameters, computation=tables) for _ in range(2))
    batch = np.array([[0.007], [0.5], [0.018]])
    first, answers = coarse.path_loss(batch[:1]), refined.path_loss(batch)
    np.testing.assert_array_equal(answers[:1], first)
    np.testing.assert_array_equal(answers[1:], refined.path_loss(batch)[1:])
    assert not np.array_equal(refined.path_loss(batch[:1]), first)


def test_large_programs_are_tabulated_without_padding(monkeypatch: pytest.MonkeyPatch) -> None:
    sequences = [(Kind.SPECULAR,), (Kind.SPECULAR, Kind.REFRACTION), (Kind.DIFFUSE,)]
    paths = synthetic.program(sequences * 2, seed=6, materials=synthetic.LAMBERTIAN)
    table = paths.material_table()[None]
    padded = layout(paths, np.float64, 512).program
    assert any("r" in group.signature for group in padded.groups)
    monkeypatch.setattr(program, "LARGE", 0)
    exact = layout(paths, np.float64, 512).program
    assert all("r" not in group.signature for group in exact.groups)
    np.testing.assert_allclose(path_losses(exact, table)[0], path_losses(padded, table)[0], rtol=1e-12)


def test_single_precision_is_enough_for_metals_at_low_frequencies() -> None:
    cosine, wavelength = jnp.linspace(1e-3, 1, 50), jnp.asarray(300.0)
    copper = (jnp.asarray(1.0), loss_term(jnp.asarray(5.8e7), wavelength))  # at 1 MHz, 1e12
    arguments = (cosine, *copper, jnp.asarray(1e-3), wavelength)
    evaluate = jax.jit(coefficients, static_argnums=5)
    single = evaluate(*(jnp.asarray(value, jnp.float32) for value in arguments), False)
    double = evaluate(*arguments, False)
    assert single[0][0].dtype == jnp.float32
    np.testing.assert_allclose(single, double, atol=1e-6)
    for real, imaginary in double:
        np.testing.assert_allclose(np.hypot(real, imaginary), 1, atol=2e-3)  # nearly all is reflected
