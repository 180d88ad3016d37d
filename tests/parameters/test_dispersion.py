"""Laws of frequency as parameters: values, derivatives, starts, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.materials import FIELDS, Material, itu_law, itu_material
from calibray.parameters import Parameter, Parameters, start_value
from calibray.parameters.parameter import CONSTANT_OF_FIELD, LAWS, power_law

BASE = {"walls": Material(5.0, 0.1, 0.3), "soil": Material(3.0, 0.01, 0.5)}
CONCRETE = itu_law("concrete", 4e9)


def parameters(*names: str) -> Parameters:
    starts = {"itu_a": 5.0, "itu_b": 0.1, "itu_c": 0.05, "itu_d": 0.8, "thickness": 0.3}
    items = (Parameter(name, 0.01, 9.0, starts[name.split(".")[1]]) for name in names)
    return Parameters(tuple(items), frequency=4e9, laws={"walls": CONCRETE})


def test_every_constant_and_coefficient_acts_on_a_constant():
    assert set(CONSTANT_OF_FIELD.values()) == set(FIELDS)
    assert {name: CONSTANT_OF_FIELD[name] for law in LAWS.values() for name in law} == {
        "itu_a": "relative_permittivity", "itu_b": "relative_permittivity",
        "itu_c": "conductivity", "itu_d": "conductivity",
    }  # fmt: skip


@pytest.mark.parametrize("frequency", [3.5e9, 28e9])
def test_the_law_with_iturs_coefficients_is_iturs_material(frequency):
    law = parameters("walls.itu_a", "walls.itu_b", "walls.itu_c", "walls.itu_d")
    wall = law.materials(CONCRETE[2:], BASE, frequency)["walls"]
    expected = itu_material("concrete", frequency)
    assert wall.relative_permittivity == pytest.approx(expected.relative_permittivity, rel=1e-14)
    assert wall.conductivity == pytest.approx(expected.conductivity, rel=1e-14)
    assert wall.thickness == 0.3


def test_a_coefficient_that_is_no_parameter_is_that_of_the_materials_law():
    law = parameters("walls.itu_c")
    wall = law.materials([0.05], BASE, 28e9)["walls"]
    assert wall.conductivity == pytest.approx(0.05 * 28**0.7822)
    assert wall.relative_permittivity == 5.0  # of which nothing is a parameter
    assert law.law_coefficients([0.05]) == {"walls": {"itu_c": 0.05, "itu_d": 0.7822}}
    exponent = parameters("walls.itu_d")
    assert exponent.materials([0.5], BASE, 28e9)["walls"].conductivity == pytest.approx(0.0462 * 28**0.5)


def test_entries_and_slopes_follow_the_law_and_leave_other_parameters_alone():
    law = parameters("walls.itu_b", "walls.thickness", "walls.itu_a", "walls.itu_c")
    points = np.random.default_rng(1).uniform(0.1, 2.0, (5, 4))
    values, slopes = law.constants_and_slopes(points, 28e9)
    np.testing.assert_allclose(values[:, 0], points[:, 2] * 28 ** points[:, 0])
    np.testing.assert_array_equal(values[:, 2], values[:, 0])
    np.testing.assert_array_equal(values[:, 1], points[:, 1])
    np.testing.assert_array_equal(slopes[:, 1], 1.0)
    for k in range(4):
        step = 1e-6 * np.eye(4)[k]
        numeric = (
            law.constants_and_slopes(points + step, 28e9)[0]
            - law.constants_and_slopes(points - step, 28e9)[0]
        )[:, k] / 2e-6
        np.testing.assert_allclose(slopes[:, k], numeric, rtol=1e-7)
    matrix = law.constants_of(points, BASE, 28e9)
    np.testing.assert_array_equal(matrix[:, 0, :3], values[:, [0, 3, 1]])
    constants, places = law.at_carrier(28e9)
    assert constants.names == ("walls.relative_permittivity", "walls.thickness", "walls.conductivity")
    assert places.tolist() == [0, 1, 0, 2]
    np.testing.assert_allclose(constants.start[places], law.constants_and_slopes(law.start, 28e9)[0])


def test_without_a_frequency_the_law_is_taken_at_the_carrier_of_the_parameters():
    law = parameters("walls.itu_a", "walls.itu_b")
    np.testing.assert_array_equal(
        law.constants_and_slopes([3.0, 0.2])[0], law.constants_and_slopes([3.0, 0.2], 4e9)[0]
    )
    assert law.constants_and_slopes([3.0, 0.2], 1e9)[0][0] == 3.0
    assert power_law(np.array(3.0), np.array(0.2), 1e9).by_exponent == 0.0


@pytest.mark.parametrize(
    ("name", "start", "value"),
    [
        ("walls.itu_d", "itu:concrete", 0.7822),
        ("walls.itu_c", "itu:concrete@P.2040-1", 0.0326),
        ("walls.itu_a", None, 5.24),  # of the law given
        ("soil.itu_a", None, 3.0),  # of constants that do not follow the frequency
        ("soil.itu_b", None, 0.0),
        ("walls.itu_b", -0.1, -0.1),
    ],
)
def test_starts_of_coefficients(name, start, value):
    assert start_value(name, start, BASE, 4e9, {"walls": CONCRETE}) == value
    bounds = (-0.5, 0.5) if name.endswith("b") else (0.001, 9)
    made = Parameter(name, *bounds, value)
    assert made.constant == LAWS_OF[made.field]


LAWS_OF = {name: constant for constant, law in LAWS.items() for name in law}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Parameter("walls.itu_a", 0.0, 9.0, 5.0), r"bounds = \[0\.0, 9\.0\]: 0\.0 must be a finite number gre"),
        (lambda: Parameter("walls.itu_c", -1.0, 9.0, 5.0), "must be a finite number not below 0 S/m"),
        (lambda: Parameter("walls.itu_b", -20.0, 1.0, 0.0), r"-20\.0 must be a number in \[-10, 10\]"),
        (lambda: Parameter("walls.itu_e", 0.0, 1.0, 0.5), "no field 'itu_e'; did you mean 'itu_"),
        (
            lambda: start_value("walls.thickness", "itu:concrete", BASE, 4e9),
            "ITU-R P.2040 does not specify thickness",
        ),
        (
            lambda: start_value("walls.itu_a", "itu:concret", BASE, 4e9),
            r"walls\.itu_a: start = 'itu:concret': 'concret' is not a material",
        ),
        (
            lambda: Parameters(
                (Parameter("walls.conductivity", 0.0, 1.0, 0.1), Parameter("walls.itu_d", 0.0, 1.0, 0.1))
            ),
            "'walls.conductivity' is independent of frequency, but 'walls.itu_d' is a coefficient of its law",
        ),
        (
            lambda: parameters("walls.itu_a", "walls.thickness").matrix_indices(list(BASE)),
            r"parameters walls\.itu_a, walls\.thickness: coefficients of frequency laws have no entry",
        ),
        (
            lambda: parameters("walls.itu_a").check_carriers([4e9, 10e9]),
            r"walls\.itu_a = 0\.01 with itu_b = 0 results in relative_permittivity = 0\.01 at 4 GHz, must be a finite "
            "number not below 1; narrow the bounds",
        ),
    ],
)  # fmt: skip
def test_what_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_the_permittivity_may_follow_a_law_while_the_conductivity_does_not():
    mixed = Parameters(
        (Parameter("walls.conductivity", 0.0, 1.0, 0.1), Parameter("walls.itu_b", -0.1, 0.1, 0.0)),
        4e9,
        {"walls": CONCRETE},
    )
    mixed.check_carriers([1e9, 1e11])
    wall = mixed.materials([0.3, 0.1], BASE, 10e9)["walls"]
    assert (wall.relative_permittivity, wall.conductivity) == (pytest.approx(5.24 * 10**0.1), 0.3)
