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
from calibray.engines.replay import Computation
from calibray.fields import layout, program_path_loss
from calibray.materials import BOUNDS, FIELDS, Material
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind, Paths

BANDWIDTH = 1e8  # [Hz]
ROUNDING = 1e-9  # [dB] per unit, resolution of differences of path losses around 100 dB
LOBES = {"lambertian": set(), "directive": {"alpha_r"}, "backscattering": {"alpha_r", "alpha_i", "lambda_"}}
LONG = [
    (),
    (Kind.SPECULAR, Kind.DIFFUSE, Kind.REFRACTION),
    (Kind.DIFFUSE, Kind.DIFFUSE),
    (Kind.SPECULAR, Kind.DIFFRACTION, Kind.SPECULAR),
]


@pytest.fixture(autouse=True)
def _nan_is_an_error() -> Iterator[None]:
    with jax.debug_nans(True):
        yield


@pytest.fixture(scope="module")
def paths() -> Paths:
    """Paths with every kind of interaction, six of each sequence, to two links and two receive ports."""
    return synthetic.program([(), *LONG[1:] * 6], seed=3, ports=(2, 1))


@pytest.fixture(scope="module")
def engine(paths: Paths) -> Replay:
    return Replay(paths, all_parameters(paths), computation=Computation(np.float64))


def all_parameters(paths: Paths) -> Parameters:
    """Every constant that its material's fields depend on."""
    parameters = []
    for name, material in paths.materials.items():
        for field in FIELDS:
            if field not in LOBES["backscattering"] or field in LOBES[material.scattering_pattern]:
                value, bound = getattr(material, field), BOUNDS[field]
                lower, upper = max(bound.lower, 0.5 * value), min(bound.upper, 1.5 * value)
                parameters.append(Parameter(f"{name}.{field}", lower, upper, start=value))
    return Parameters(tuple(parameters))


def central_differences(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """Derivatives [..., d] by central differences, extrapolated to step 0 (Richardson, error of order 6)."""
    columns = []
    for index, value in enumerate(at):
        slopes = []
        for step in (4e-3 * value, 2e-3 * value, 1e-3 * value):
            shift = np.zeros_like(at)
            shift[index] = step
            above, below = function(np.stack([at + shift, at - shift]))
            slopes.append((above - below) / (2 * step))
        once = [(4 * fine - coarse) / 3 for coarse, fine in pairwise(slopes)]
        columns.append((16 * once[1] - once[0]) / 15)
    return np.stack(columns, axis=-1)


def test_jacobian_equals_central_differences(engine: Replay) -> None:
    at = engine.parameters.start
    assert len(at) == 3 * 5 + 1 + 3  # the last ones shape the two lobes
    loss, jacobian = engine.path_loss_and_jacobian(at[None])
    np.testing.assert_allclose(loss, engine.path_loss(at[None]), rtol=1e-13)
    expected = central_differences(engine.path_loss, at)
    assert (np.abs(expected).max(axis=0) > 1e-3).all()  # every parameter acts on some link
    np.testing.assert_allclose(jacobian[0], expected, rtol=1e-5, atol=ROUNDING)
    # negative control: a relative error of 1e-4 is noticed
    jacobian[0, np.abs(expected[:, 0]).argmax(), 0] *= 1 + 1e-4
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(jacobian[0], expected, rtol=1e-5, atol=ROUNDING)


@pytest.mark.parametrize("combining", ["coherent", "band"])
def test_jacobian_of_combined_fields_equals_central_differences(combining: str) -> None:
    paths = synthetic.program(
        [(Kind.SPECULAR,), (Kind.DIFFUSE,)] * 6, seed=3, ports=(2, 1), materials=synthetic.LAMBERTIAN
    )
    engine = Replay(paths, all_parameters(paths), combining, BANDWIDTH, computation=Computation(np.float64))
    at = engine.parameters.start
    _, jacobian = engine.path_loss_and_jacobian(at[None])
    expected = central_differences(lambda points: engine.path_loss_and_jacobian(points)[0], at)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(jacobian[0], expected, rtol=1e-5, atol=ROUNDING)


def test_forward_mode_through_the_pure_function_equals_the_engine() -> None:
    paths = synthetic.program([(Kind.SPECULAR,)] * 6, seed=3)
    parameters = all_parameters(paths)
    rows, columns = parameters.matrix_indices(list(paths.materials))
    program, table = layout(paths).program, jnp.asarray(paths.material_table())

    @jax.jit
    def rate(direction: np.ndarray) -> jax.Array:
        return jax.jvp(lambda table: program_path_loss(program, table), (table,), (direction,))[1]

    step = np.random.default_rng(1).normal(size=len(parameters))
    direction = np.zeros(table.shape)
    direction[rows, columns] = step
    _, jacobian = Replay(paths, parameters, computation=Computation(np.float64)).path_loss_and_jacobian(
        parameters.start[None]
    )
    np.testing.assert_allclose(rate(direction), jacobian[0] @ step, rtol=1e-9)
    # exponents of patterns that have none
    unused = np.ones(table.shape)
    unused[rows, columns] = 0.0
    assert (rate(unused) == 0).all()


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
    cosine = paths.cos_incidence.copy()
    cosine[::5], cosine[1::5] = 1.0, 1e-6  # normal and grazing incidence as well
    engine = Replay(
        replace(paths, cos_incidence=cosine), all_parameters(paths), computation=Computation(np.float64)
    )
    candidate = [EDGES[edge].get(parameter.field, parameter.start) for parameter in engine.parameters]
    loss, jacobian = engine.path_loss_and_jacobian(np.array([candidate]))
    assert np.isfinite(loss[0, 0])
    assert np.isfinite(loss[0, 1]) if edge != "air" else np.isposinf(loss[0, 1])  # air reflects nothing
    assert np.isfinite(jacobian).all()


@pytest.mark.parametrize("field", ["conductivity", "scattering_coefficient"])
def test_derivative_at_zero_is_the_limit_from_above(engine: Replay, field: str) -> None:
    is_field = np.array([parameter.field == field for parameter in engine.parameters])
    at_zero, index = np.where(is_field, 0.0, engine.parameters.start), int(is_field.argmax())

    def loss(value: float) -> np.ndarray:
        candidate = at_zero.copy()
        candidate[index] = value
        return engine.path_loss(candidate[None])[0]

    _, jacobian = engine.path_loss_and_jacobian(at_zero[None])
    step = 1e-5
    slopes = [(loss(h) - loss(0.0)) / h for h in (step, step / 2)]
    np.testing.assert_allclose(jacobian[0, :, index], 2 * slopes[1] - slopes[0], rtol=1e-4, atol=1e-6)


def test_a_link_without_a_path_and_an_unused_material_have_no_slope() -> None:
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
