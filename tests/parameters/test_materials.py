from dataclasses import FrozenInstanceError, replace
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibray.errors import InputError
from calibray.materials import (
    BOUNDS,
    FIELDS,
    ITU_MATERIALS,
    Material,
    constants_matrix,
    itu_material,
)

PLAIN = Material(relative_permittivity=5.0, conductivity=0.1, thickness=0.2)

# The examples printed on the documentation page of MATLAB's buildingMaterialPermittivity at 9 GHz: in release
# R2021a for P.2040-1, in later ones for P.2040-3 (Antenna and Communications Toolbox).
MATLAB_AT_9_GHZ = {
    "P.2040-1": {
        "vacuum": (1, 0),
        "concrete": (5.31, 0.19305),
        "brick": (3.75, 0.038),
        "plasterboard": (2.94, 0.054914),
        "wood": (1.99, 0.049528),
        "glass": (6.27, 0.059075),
        "ceiling_board": (1.5, 0.0064437),
        "chipboard": (2.58, 0.12044),
        "metal": (1, 1e7),
    },
    "P.2040-3": {
        "vacuum": (1, 0),
        "concrete": (5.24, 0.25766),
        "brick": (3.91, 0.033826),
        "plasterboard": (2.73, 0.066978),
        "wood": (1.99, 0.049528),
        "glass": (6.31, 0.068299),
        "ceiling_board": (1.48, 0.011674),
        "chipboard": (2.58, 0.12044),
        "plywood": (2.71, 0.33),
        "marble": (7.074, 0.04209),
        "metal": (1, 1e7),
    },
}


@pytest.mark.parametrize(
    ("revision", "name"), [(revision, name) for revision, rows in MATLAB_AT_9_GHZ.items() for name in rows]
)
def test_laws_give_the_numbers_that_matlab_documents(revision, name):
    material = itu_material(name, 9e9, revision=revision)
    permittivity, conductivity = MATLAB_AT_9_GHZ[revision][name]
    assert material.relative_permittivity == permittivity
    assert material.conductivity == pytest.approx(conductivity, rel=5e-5)


def test_ground_laws_have_their_frequency_dependence():
    # At 10 GHz the powers are decibels: 10^-0.1 = 0.794328, 10^-0.4 = 0.398107, 10^2.52 = 331.131
    assert itu_material("medium_dry_ground", 10e9).relative_permittivity == pytest.approx(15 * 0.794328, 1e-6)
    assert itu_material("wet_ground", 10e9).relative_permittivity == pytest.approx(30 * 0.398107, 1e-6)
    assert itu_material("very_dry_ground", 10e9).conductivity == pytest.approx(0.00015 * 331.131, 1e-6)


def test_revision_four_is_the_table_of_sionna():
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    ours = {
        name: [((law.lower, law.upper), (law.a, law.b, law.c, law.d)) for law in laws]
        for name, laws in ITU_MATERIALS["P.2040-4"].items()
    }
    assert ours == {name: list(rows.items()) for name, rows in ITU_MATERIALS_PROPERTIES.items()}


@pytest.mark.parametrize("name", sorted(ITU_MATERIALS["P.2040-3"]))
def test_revision_three_agrees_with_sionna_within_its_ranges(name):
    from sionna.rt.radio_materials.itu import itu_material as sionna_itu_material

    for law in ITU_MATERIALS["P.2040-3"][name]:
        for frequency in (law.lower * 1e9, (law.lower * law.upper) ** 0.5 * 1e9, law.upper * 1e9):
            material = itu_material(name, frequency)
            permittivity, conductivity = sionna_itu_material(name, frequency)
            assert material.relative_permittivity == pytest.approx(float(permittivity), rel=1e-12)
            assert material.conductivity == pytest.approx(float(conductivity), rel=1e-12)


@pytest.mark.parametrize("revision", ITU_MATERIALS)
def test_range_ends_are_included_and_nothing_beyond(revision):
    for name, laws in ITU_MATERIALS[revision].items():
        lower, upper = min(law.lower for law in laws) * 1e9, max(law.upper for law in laws) * 1e9
        assert itu_material(name, lower, revision=revision).relative_permittivity >= 1
        assert itu_material(name, upper, revision=revision).relative_permittivity >= 1
        for outside in (lower * (1 - 1e-9), upper * (1 + 1e-9)):
            with pytest.raises(InputError, match=f"{revision} covers '{name}' at|must be from"):
                itu_material(name, outside, revision=revision)


def test_a_gap_between_two_ranges_is_refused_with_both_ranges_and_a_remedy():
    with pytest.raises(InputError) as error:
        itu_material("glass", 150e9)
    assert str(error.value) == (
        "ITU-R P.2040-3 covers 'glass' at 0.1 to 100 GHz and 220 to 450 GHz, not at 150 GHz: "
        "give relative_permittivity and conductivity instead"
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("concret", 4e9), "did you mean 'concrete'"),
        (("unobtainium", 4e9), "use one of: vacuum, concrete"),
        (("asphalt_concrete", 4e9), "it is in P.2040-4"),
        (("concrete", 4e9, 0.1, "P.2040-9"), "revision = 'P.2040-9'"),
        (("concrete", nan), "frequency = nan"),
        (("concrete", -4e9), "frequency = -4"),
        (("concrete", 4e9, 0.0), "thickness = 0.0: must be a finite number greater than 0 m"),
    ],
)
def test_unknown_names_and_impossible_numbers_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        itu_material(*arguments)


def test_scattering_fields_pass_through():
    material = itu_material("brick", 28.5e9, 0.3, scattering_coefficient=0.4, scattering_pattern="directive")
    assert (material.scattering_coefficient, material.scattering_pattern) == (0.4, "directive")


@given(st.sampled_from(FIELDS), st.floats(allow_nan=True, allow_infinity=True))
def test_a_material_holds_exactly_what_its_bounds_allow(field, value):
    bound = BOUNDS[field]
    possible = (
        bound.lower <= value <= bound.upper and value != inf and not (field == "thickness" and value == 0)
    )
    if possible:
        assert getattr(replace(PLAIN, **{field: value}), field) == value
    else:
        with pytest.raises(InputError, match=f"^{field} = "):
            replace(PLAIN, **{field: value})


@pytest.mark.parametrize("value", ["5.0", None, True, [5.0, 6.0]])
def test_a_material_refuses_what_is_no_number(value):
    with pytest.raises(InputError, match=r"relative_permittivity = .*: must be a finite number not below 1"):
        replace(PLAIN, relative_permittivity=value)


def test_a_material_refuses_lobes_for_which_sionna_rt_has_no_finite_gains():
    with pytest.raises(InputError, match=r"alpha_r = 127: must be a number in \[1, 126\]"):
        replace(PLAIN, alpha_r=127)


def test_a_material_refuses_an_unknown_pattern_and_cannot_be_changed():
    with pytest.raises(InputError, match="did you mean 'lambertian'"):
        replace(PLAIN, scattering_pattern="lambertain")
    with pytest.raises(FrozenInstanceError):
        PLAIN.thickness = 1.0


def test_bounds_are_those_of_sionna():
    # Sionna RT takes every bound and refuses what lies below; it also takes the empty slab that we refuse.
    import sionna.rt

    for field in FIELDS[:5]:
        for value in (BOUNDS[field].lower, BOUNDS[field].upper):
            if value != inf:
                sionna.rt.RadioMaterial("edge", **{field: value})
        with pytest.raises(ValueError, match="must be"):
            sionna.rt.RadioMaterial("beyond", **{field: BOUNDS[field].lower - 1e-3})


def test_constants_follow_the_field_order():
    other = replace(PLAIN, scattering_coefficient=0.3, xpd_coefficient=0.2, alpha_r=4, alpha_i=3, lambda_=0.7)
    matrix = constants_matrix({"a": PLAIN, "b": other})
    np.testing.assert_array_equal(matrix, [[5, 0.1, 0.2, 0, 0, 1, 1, 1], [5, 0.1, 0.2, 0.3, 0.2, 4, 3, 0.7]])
    assert constants_matrix({}).shape == (0, len(FIELDS))
