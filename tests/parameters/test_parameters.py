from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibray.errors import InputError
from calibray.materials import FIELDS, Material, constants_matrix
from calibray.parameters import LogNormal, Parameter, Parameters, split_name, start_value

BASE = {
    "ground": Material(3.0, 0.01, 0.5),
    "walls": Material(5.24, 0.14, 0.3, scattering_coefficient=0.2),
    "tower.7": Material(
        6.0, 0.02, 0.01, scattering_pattern="backscattering", alpha_r=4, alpha_i=2, lambda_=0.6
    ),
}
PARAMETERS = Parameters(
    (
        Parameter("walls.relative_permittivity", 1.5, 12.0, 5.0),
        Parameter("tower.7.lambda_", 0.0, 1.0, 0.6),
        Parameter("ground.conductivity", 1e-4, 1.0, 0.01, scale="log"),
        Parameter("walls.thickness", 0.05, 0.6, 0.3),
    )
)
unit_vectors = st.lists(st.floats(0, 1), min_size=4, max_size=4)


def test_arrays_follow_the_order_of_the_parameters():
    assert PARAMETERS.names[1] == "tower.7.lambda_"
    np.testing.assert_array_equal(PARAMETERS.lower, [1.5, 0, 1e-4, 0.05])
    np.testing.assert_array_equal(PARAMETERS.upper, [12, 1, 1, 0.6])
    np.testing.assert_array_equal(PARAMETERS.start, [5, 0.6, 0.01, 0.3])
    assert PARAMETERS.logarithmic.tolist() == [False, False, True, False]
    assert (len(PARAMETERS), [parameter.material for parameter in PARAMETERS]) == (
        4,
        ["walls", "tower.7", "ground", "walls"],
    )


def test_a_candidate_changes_its_fields_and_nothing_else():
    materials = PARAMETERS.materials([7.0, 0.25, 0.5, 0.1], BASE)
    assert list(materials) == list(BASE)
    assert materials["walls"] == replace(BASE["walls"], relative_permittivity=7.0, thickness=0.1)
    assert materials["tower.7"] == replace(BASE["tower.7"], lambda_=0.25)
    assert materials["ground"] == replace(BASE["ground"], conductivity=0.5)


@given(st.lists(unit_vectors, min_size=1, max_size=4))
def test_the_batch_of_constants_equals_the_materials_one_by_one(units):
    candidates = PARAMETERS.from_unit(units)
    batch = PARAMETERS.constants_of(candidates, BASE)
    assert batch.shape == (len(units), len(BASE), len(FIELDS))
    for candidate, matrix in zip(candidates, batch, strict=True):
        np.testing.assert_array_equal(matrix, constants_matrix(PARAMETERS.materials(candidate, BASE)))


def test_indices_point_at_the_cells_that_a_candidate_sets():
    rows, columns = PARAMETERS.matrix_indices(["walls", "ground", "tower.7"])
    assert rows.tolist() == [0, 2, 1, 0]
    assert [FIELDS[column] for column in columns] == [
        "relative_permittivity",
        "lambda_",
        "conductivity",
        "thickness",
    ]


@given(unit_vectors)
def test_unit_scaling_round_trips_within_the_bounds(unit):
    candidate = PARAMETERS.from_unit(unit)
    assert np.all((PARAMETERS.lower <= candidate) & (candidate <= PARAMETERS.upper))
    np.testing.assert_allclose(PARAMETERS.to_unit(candidate), unit, atol=1e-12)


def test_unit_scaling_maps_bounds_and_the_geometric_middle():
    np.testing.assert_allclose(PARAMETERS.from_unit([0, 0, 0, 0]), PARAMETERS.lower, rtol=1e-14)
    np.testing.assert_allclose(PARAMETERS.from_unit([1, 1, 1, 1]), PARAMETERS.upper, rtol=1e-14)
    np.testing.assert_allclose(PARAMETERS.from_unit([0.5] * 4), [6.75, 0.5, 1e-2, 0.325])
    np.testing.assert_array_equal(
        PARAMETERS.to_unit([PARAMETERS.lower, PARAMETERS.upper]), [[0] * 4, [1] * 4]
    )


def test_rounding_of_logarithms_never_leaves_the_bounds():
    rng = np.random.default_rng(0)
    for lower in 10 ** rng.uniform(-6, 0, 200):
        parameter = Parameters((Parameter("walls.conductivity", lower, 3 * lower, 2 * lower, scale="log"),))
        assert lower <= parameter.from_unit([0.0])[0] <= parameter.from_unit([1.0])[0] <= 3 * lower


@given(st.text(min_size=1), st.sampled_from(FIELDS))
def test_names_part_at_the_last_dot(material, field):
    assert split_name(f"{material}.{field}") == (material, field)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("walls.permitivity", 1, 2, 1), "no field 'permitivity'"),
        (("walls.relative_permitivity", 1, 2, 1), "did you mean 'relative_permittivity'"),
        (("relative_permittivity", 1, 2, 1), "must consist of a material and a field"),
        (("walls.relative_permittivity", 12, 1.5, 5), r"bounds = \[12, 1.5\] are reversed"),
        (("walls.relative_permittivity", 5, 5, 5), "are equal.*in \\[materials\\]"),
        (("walls.relative_permittivity", 0.5, 5, 2), "0.5 must be a finite number not below 1"),
        (("walls.relative_permittivity", nan, 5, 2), "nan must be a finite number"),
        (("walls.relative_permittivity", 1, inf, 2), "inf must be a finite number"),
        (("walls.conductivity", -0.1, 1, 0.5), "-0.1 must be a finite number not below 0 S/m"),
        (("walls.thickness", 0, 1, 0.5), "0 must be a finite number greater than 0 m"),
        (("walls.scattering_coefficient", 0, 1.5, 0.5), r"1.5 must be a number in \[0, 1\]"),
        (("walls.relative_permittivity", 2, 5, 1.5), "start = 1.5 is outside bounds"),
        (("walls.relative_permittivity", 2, 5, nan), "start = nan is outside bounds"),
        (("walls.relative_permittivity", 2, 5, 3, "logarithmic"), "must be one of linear, log"),
        (("walls.conductivity", 0, 5, 3, "log"), "the lower bound must be greater than 0"),
    ],
)
def test_impossible_parameters_are_refused(arguments, message):
    with pytest.raises(InputError, match=rf"{message}"):
        Parameter(*arguments)


def test_impossible_sets_and_candidates_are_refused():
    with pytest.raises(InputError, match="none given"):
        Parameters(())
    with pytest.raises(InputError, match=r"'walls\.thickness' is given twice"):
        Parameters((*PARAMETERS.items, Parameter("walls.thickness", 0.1, 0.2, 0.1)))
    for method in (PARAMETERS.to_unit, PARAMETERS.from_unit):
        with pytest.raises(InputError, match=r"shape \(3,\), must end in 4"):
            method([1, 2, 3])
    with pytest.raises(InputError, match=r"shape \(1, 4\), must be \(4,\)"):
        PARAMETERS.materials([[1, 2, 3, 4]], BASE)
    with pytest.raises(InputError, match="relative_permittivity = nan"):
        PARAMETERS.materials([nan, 0.5, 0.1, 0.1], BASE)
    with pytest.raises(InputError, match="no material 'walls'; did you mean 'wall'"):
        PARAMETERS.materials(PARAMETERS.start, {"wall": BASE["walls"]})
    with pytest.raises(InputError, match=r"no material 'tower\.7'"):
        PARAMETERS.matrix_indices(["walls", "ground"])


@pytest.mark.parametrize(
    ("name", "start", "value"),
    [
        ("walls.relative_permittivity", None, 5.24),
        ("walls.relative_permittivity", 4, 4.0),
        ("walls.relative_permittivity", "itu:concrete@P.2040-1", 5.31),
        ("walls.relative_permittivity", "itu:concrete", 5.24),
        ("walls.conductivity", "itu:glass@P.2040-1", 0.0043 * 4**1.1925),
    ],
)
def test_starts_resolve_to_numbers(name, start, value):
    assert start_value(name, start, BASE, 4e9) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("name", "start", "message"),
    [
        ("wals.relative_permittivity", 2, "the scene has no material 'wals'; did you mean 'walls'"),
        ("walls.relative_permittivity", "itu:concret", "start = 'itu:concret': .*did you mean 'concrete'"),
        ("walls.relative_permittivity", "itu:wet_ground", "not at 28.5 GHz"),
        ("walls.relative_permittivity", "itu:concrete@P.2040-0", "revision = 'P.2040-0'"),
        ("walls.relative_permittivity", "concrete", "must be a number or 'itu:NAME'"),
        ("walls.relative_permittivity", nan, "start = nan: must be a finite number"),
        ("walls.relative_permittivity", True, "start = True: must be a finite number"),
        ("walls.thickness", "itu:concrete", "does not specify thickness"),
        ("walls.alpha_r", None, "has no effect: the scattering pattern of 'walls' is 'lambertian'"),
        ("walls.relative_permittivity", "itu:metal", "start = 1 is outside bounds"),
        ("ground.relative_permittivity", None, None),
    ],
)
def test_starts_that_cannot_be_are_refused(name, start, message):
    def make():
        return Parameter(name, 2.0, 12.0, start_value(name, start, BASE, 28.5e9))

    if message is None:  # the negative control
        assert make().start == 3.0
    else:
        with pytest.raises(InputError, match=message):
            make()


def test_a_linear_prior_is_gaussian_in_the_value():
    prior = LogNormal((0, 2), (4.0, 1.0), (0.3, 5.0), linear=(2,))
    candidates = np.array([[8.0, 1.0, -9.0], [4.0, 1.0, 1.0]])
    assert prior.residuals(candidates) == pytest.approx(np.array([[np.log(2) / 0.3, -2.0], [0.0, 0.0]]))
    step = np.array([[0.0, 0.0, 1e-6]])
    slope = (prior.residuals(candidates[:1] + step) - prior.residuals(candidates[:1] - step)) / 2e-6
    assert prior.jacobian(candidates[:1])[0, :, 2] == pytest.approx(slope[0])


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_members_of_a_population_scatter_around_their_common_value(scale):
    items = Parameter("walls.thickness", 0.1, 2.0, 0.3), Parameter("shops.thickness", 0.05, 1.0, 0.3, scale)
    parameters = Parameters(items)
    prior = LogNormal((1,), (1.0,), (0.4,), like=((1, 0),))
    values = np.array([[0.3, 0.3], [0.5, 0.2], [1.8, 0.9]])
    assert prior.residuals(values)[:, 0] == pytest.approx(np.log(values[:, 1] / values[:, 0]) / 0.4)
    jacobian = prior.jacobian(values)
    for column in range(2):
        step = 1e-6 * np.eye(2)[column]
        slope = (prior.residuals(values + step) - prior.residuals(values - step)) / 2e-6
        assert jacobian[:, :, column] == pytest.approx(slope, rel=1e-6)
    # The normalization is that of the density over the search space, up to a constant.
    unit = (np.arange(20_000) + 0.5) / 20_000
    line = parameters.from_unit(np.column_stack([unit, unit]))[:, 1]
    integral = [
        np.exp(-0.5 * prior.residuals(np.column_stack([np.full(20_000, wall), line]))[:, 0] ** 2).mean()
        for wall in values[:, 0]
    ]
    found = prior.log_normalization(values, parameters)
    assert found - found[0] == pytest.approx(np.log(np.array(integral) / integral[0]), abs=1e-6)
    # Draws have that density: their quantiles are those of its integral.
    random = np.random.default_rng(1)
    drawn = prior.draw_like(np.tile(values[1], (40_000, 1)), parameters, random)
    density = np.exp(-0.5 * prior.residuals(np.column_stack([np.full(20_000, 0.5), line]))[:, 0] ** 2)
    expected = np.interp([0.1, 0.5, 0.9], np.cumsum(density) / density.sum(), line)
    assert np.quantile(drawn[:, 1], [0.1, 0.5, 0.9]) == pytest.approx(expected, rel=0.02)
    assert (drawn[:, 0] == 0.5).all()


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_members_far_from_their_common_value_are_near_a_bound(scale):
    """Bounds of a member that lie many standard deviations above or below the common value."""
    items = Parameter("walls.thickness", 0.01, 10.0, 0.3), Parameter("shops.thickness", 0.3, 0.5, 0.4, scale)
    parameters, prior = Parameters(items), LogNormal((1,), (1.0,), (0.1,), like=((1, 0),))
    wall = np.array([0.05, 0.1, 0.12, 0.4, 1.5, 4.0])
    values = np.column_stack([wall, np.full(6, 0.4)])
    unit = (np.arange(100_000) + 0.5) / 100_000
    line = parameters.from_unit(np.column_stack([unit, unit]))[:, 1]
    exponent = -0.5 * (np.log(line / wall[:, None]) / 0.1) ** 2
    expected = np.log(np.exp(exponent - exponent.max(axis=1)[:, None]).mean(axis=1)) + exponent.max(axis=1)
    found = prior.log_normalization(values, parameters)
    assert found - found[3] == pytest.approx(expected - expected[3], abs=1e-4)
    drawn = prior.draw_like(np.tile(values, (4000, 1)), parameters, np.random.default_rng(1))[:, 1]
    mean = (np.exp(exponent - exponent.max(axis=1)[:, None]) * line).sum(axis=1)
    mean /= np.exp(exponent - exponent.max(axis=1)[:, None]).sum(axis=1)
    assert drawn.reshape(-1, 6).mean(axis=0) == pytest.approx(mean, rel=1e-3)


def test_further_priors_extend_those_of_a_study():
    prior = LogNormal((0, 2), (4.0, 1.0), (0.3, 5.0), linear=(2,), like=((0, 1),))
    more = prior.extended([3], [2.0], 0.1)
    assert (more.index, more.centre, more.spread) == ((0, 2, 3), (4.0, 1.0, 2.0), (0.3, 5.0, 0.1))
    assert (more.linear, more.like) == (prior.linear, prior.like)
    # A value of 0 has no logarithm; only a scattering coefficient can have it.
    zero = prior.extended([3, 4], [2.0, 0.0], 0.1)
    assert (zero.spread, zero.linear) == ((0.3, 5.0, 0.1, 0.25), (2, 4))


def test_points_below_the_lower_bound_have_its_value():
    parameters = Parameters((Parameter("walls.scattering_coefficient", 0.0, 0.75, 0.0, at_lower=0.25),))
    assert parameters.from_unit([[0.0], [0.1], [0.25], [0.5], [1.0]])[:, 0].tolist() == [0, 0, 0, 0.25, 0.75]
    assert parameters.from_unit(parameters.to_unit([[0.0], [0.3]])) == pytest.approx(np.array([[0.0], [0.3]]))
