"""Derivatives of path loss by every constant of every material, against central differences."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import synthetic
from calibray.engines import Replay
from calibray.fields import GroupedProgram, layout, material_table, program_path_loss
from calibray.materials import BOUNDS, FIELDS, Material
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind, Paths

BANDWIDTH = 1e8  # [Hz]
ROUNDING = 1e-9  # [dB] per unit, what differences of path losses around 100 dB can resolve
LOBES = {"lambertian": set(), "directive": {"alpha_r"}, "backscattering": {"alpha_r", "alpha_i", "lambda_"}}


@pytest.fixture(autouse=True)
def _nan_is_an_error() -> Iterator[None]:
    """JAX raises wherever a NaN appears on the way, even one that a later selection would hide."""
    with jax.debug_nans(True):
        yield


@pytest.fixture(scope="module")
def paths() -> Paths:
    """Paths with every kind of interaction, six of each sequence, to two links and two receive ports."""
    sequences = [sequence for sequence in synthetic.EVERY_KIND if len(sequence) > 1]
    return synthetic.program([(), *sequences * 6], seed=3, ports=(2, 1))


def all_parameters(paths: Paths) -> Parameters:
    """Every constant that its material's fields depend on."""
    items = []
    for name, material in paths.materials.items():
        for field in FIELDS:
            if field not in LOBES["backscattering"] or field in LOBES[material.scattering_pattern]:
                value = getattr(material, field)
                items.append(Parameter(f"{name}.{field}", *interval(field, value), start=value))
    return Parameters(tuple(items))


def interval(field: str, value: float) -> tuple[float, float]:
    """Bounds around a value, within physics."""
    bound = BOUNDS[field]
    return max(bound.lower, 0.5 * value), min(bound.upper, 1.5 * value)


def _value_and_jacobian(program: GroupedProgram, table: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Path loss [L] and its derivatives by all constants of all materials [L, M, 8], by forward mode."""
    jacobian, value = _forward(program, table)
    return np.asarray(value), np.asarray(jacobian)


@jax.jit
def _forward(program: GroupedProgram, table: jax.Array) -> tuple[jax.Array, jax.Array]:
    def twice(table: jax.Array) -> tuple[jax.Array, jax.Array]:
        value = program_path_loss(program, table)
        return value, value

    return jax.jacfwd(twice, has_aux=True)(table)


def central_differences(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """Derivatives [..., d] by central differences, extrapolated to step 0 (Richardson, error of order 6)."""
    columns = []
    for index, value in enumerate(at):
        slopes = []
        for step in (4e-3 * value, 2e-3 * value, 1e-3 * value):
            shift = np.zeros_like(at)
            shift[index] = step
            slopes.append((function(at + shift) - function(at - shift)) / (2 * step))
        once = [(4 * fine - coarse) / 3 for coarse, fine in pairwise(slopes)]
        columns.append((16 * once[1] - once[0]) / 15)
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("combining", ["power", "coherent", "band"])
def test_jacobian_equals_central_differences(paths: Paths, combining: str) -> None:
    parameters = all_parameters(paths)
    assert len(parameters) == 3 * 5 + 1 + 3  # the last ones shape the two lobes
    engine = Replay(paths, parameters, combining, BANDWIDTH, dtype=np.float64)
    values = parameters.start
    loss, jacobian = engine.path_loss_and_jacobian(values[None])
    np.testing.assert_allclose(loss, engine.path_loss(values[None]), rtol=1e-13)
    expected = central_differences(lambda point: engine.path_loss(point[None])[0], values)
    assert (np.abs(expected).max(axis=0) > 1e-3).all()  # every parameter acts on some link
    np.testing.assert_allclose(jacobian[0], expected, rtol=1e-5, atol=ROUNDING)


def test_forward_mode_through_the_pure_function_equals_the_engine(paths: Paths) -> None:
    parameters = all_parameters(paths)
    rows, columns = parameters.matrix_indices(list(paths.materials))
    value, full = _value_and_jacobian(layout(paths).program, jnp.asarray(material_table(paths)))
    engine = Replay(paths, parameters, dtype=np.float64)
    loss, jacobian = engine.path_loss_and_jacobian(parameters.start[None])
    np.testing.assert_allclose(loss[0], value, rtol=1e-13)
    np.testing.assert_allclose(jacobian[0], full[:, rows, columns], rtol=1e-9, atol=1e-12)
    free = np.ones(full.shape[1:], dtype=bool)
    free[rows, columns] = False
    assert (full[:, free] == 0).all()  # the exponents of patterns that have none


def test_wrong_derivatives_would_be_noticed(paths: Paths) -> None:
    """The comparison's negative control: one relative error of 1e-4."""
    parameters = all_parameters(paths)
    engine = Replay(paths, parameters, dtype=np.float64)
    _, jacobian = engine.path_loss_and_jacobian(parameters.start[None])
    expected = central_differences(lambda point: engine.path_loss(point[None])[0], parameters.start)
    jacobian[0, np.abs(expected[:, 0]).argmax(), 0] *= 1 + 1e-4
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(jacobian[0], expected, rtol=1e-5, atol=ROUNDING)


EDGES = {
    "lossless": {"conductivity": 0.0},
    "air": {"relative_permittivity": 1.0, "conductivity": 0.0},
    "metal": {"relative_permittivity": 1.0, "conductivity": 1e7},
    "smooth": {"scattering_coefficient": 0.0, "xpd_coefficient": 0.0},
    "all scattered, all crossed": {"scattering_coefficient": 1.0, "xpd_coefficient": 1.0},
    "one lobe": {"lambda_": 1.0},
    "the other lobe": {"lambda_": 0.0},
}


@pytest.mark.parametrize("edge", EDGES)
def test_derivatives_are_finite_at_the_edges_of_physics(paths: Paths, edge: str) -> None:
    materials = {name: replace(material, **EDGES[edge]) for name, material in paths.materials.items()}
    grazing = paths.cos_incidence.copy()
    grazing[::5], grazing[1::5] = 1.0, 1e-6  # normal and grazing incidence as well
    program = layout(replace(paths, cos_incidence=grazing)).program
    value, jacobian = _value_and_jacobian(program, jnp.asarray(material_table(paths, materials)))
    assert np.isfinite(value[0])
    assert np.isfinite(value[1]) if edge != "air" else np.isposinf(value[1])  # air reflects nothing
    assert np.isfinite(jacobian).all()


@pytest.mark.parametrize("field", ["conductivity", "scattering_coefficient"])
def test_derivative_at_zero_is_the_limit_from_above(paths: Paths, field: str) -> None:
    column = FIELDS.index(field)
    materials = {name: replace(material, **{field: 0.0}) for name, material in paths.materials.items()}
    program, table = layout(paths).program, material_table(paths, materials)
    _, jacobian = _value_and_jacobian(program, jnp.asarray(table))

    def loss(value: float) -> np.ndarray:
        shifted = table.copy()
        shifted[0, column] = value
        return np.asarray(_value_and_jacobian(program, jnp.asarray(shifted))[0])

    step = 1e-5
    slopes = [(loss(h) - loss(0.0)) / h for h in (step, step / 2)]
    np.testing.assert_allclose(jacobian[:, 0, column], 2 * slopes[1] - slopes[0], rtol=1e-4, atol=1e-6)


def test_a_link_without_a_path_and_a_material_that_no_path_meets_have_no_slope() -> None:
    paths = synthetic.program([(Kind.SPECULAR,)] * 3, links=1, materials={"walls": Material(4.3, 0.08, 0.18)})
    paths = replace(
        paths,
        tx_position=np.zeros((2, 3)),
        rx_position=np.ones((2, 3)),
        materials={**paths.materials, "roof": Material(3.0, 0.1, 0.2)},
    )
    parameters = Parameters(
        (
            Parameter("walls.relative_permittivity", 1.0, 9.0, start=4.3),
            Parameter("roof.relative_permittivity", 1.0, 9.0, start=3.0),
        )
    )
    loss, jacobian = Replay(paths, parameters).path_loss_and_jacobian(parameters.start[None])
    assert np.isfinite(loss[0, 0])
    assert np.isposinf(loss[0, 1])
    assert jacobian[0, 0, 0] != 0
    assert (jacobian[0].ravel()[1:] == 0).all()
