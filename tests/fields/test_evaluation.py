"""Path gains and path loss against independent arithmetic, and against numbers of an earlier version."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calibray as cb
import reference_fields
import synthetic
from calibray.fields import layout, path_gains, path_loss
from calibray.paths import Kind

GOLDEN = Path(__file__).parents[1] / "golden"


def test_gains_equal_complex_arithmetic_whatever_the_padding() -> None:
    """Runs of different lengths share a group, so that shorter ones are padded, before or after other interactions."""
    sequences = [(Kind.SPECULAR,) * depth for depth in (1, 0, 3, 2, 3)]
    sequences += [
        (Kind.SPECULAR, Kind.DIFFUSE),
        (Kind.DIFFUSE, Kind.REFRACTION),
        (Kind.DIFFUSE, Kind.DIFFUSE),
    ]
    paths = synthetic.program(sequences, seed=3, ports=(2, 2), materials=synthetic.LAMBERTIAN)
    assert len(layout(paths).program.groups) == 3
    expected = reference_fields.gains(paths)
    np.testing.assert_allclose(path_gains(paths), expected, rtol=1e-11)
    # Power is summed over receive ports and averaged over transmit ports.
    power = (np.abs(expected) ** 2).sum(axis=(1, 2)) / 2
    np.testing.assert_allclose(path_loss(paths), -10 * np.log10(np.bincount(paths.link, power)), rtol=1e-12)


def test_a_path_of_more_than_sixteen_interactions_has_the_gain_that_it_has_alone() -> None:
    sequences = [(Kind.DIFFUSE,), (Kind.DIFFUSE, Kind.DIFFUSE), (Kind.REFRACTION,) * 16 + (Kind.DIFFUSE,), ()]
    paths = synthetic.program(sequences, seed=3, materials=synthetic.LAMBERTIAN)
    np.testing.assert_allclose(path_gains(paths), reference_fields.gains(paths)[:, 0, 0], rtol=1e-11)


@pytest.mark.parametrize("name", ["cos_specular", "cos_backward"])
def test_cosines_rounded_below_minus_one_have_the_loss_of_minus_one(name: str) -> None:
    paths = synthetic.program([[Kind.DIFFUSE]])
    ground = list(paths.materials).index("ground")  # backscattering, with exponents that are no whole numbers
    exact, rounded = (
        replace(
            paths, material=np.array([ground]), diffuse=replace(paths.diffuse, **{name: np.array([cosine])})
        )
        for cosine in (-1.0, -1.0000001)
    )
    loss = path_loss(exact)
    assert np.isfinite(loss[paths.link]).all()
    np.testing.assert_array_equal(path_loss(rounded), loss)


def test_padding_is_not_evaluated_at_the_end_of_a_run() -> None:
    paths = synthetic.program([(Kind.SPECULAR,) * depth for depth in (1, 0, 3, 2, 3)], seed=3)
    program = layout(paths).program
    assert [group.signature for group in program.groups] == ["r"]
    assert len(program.coefficients.cosine) == paths.num_interactions == 9


def test_path_loss_is_that_of_an_earlier_version() -> None:
    """All kinds of interaction, traced in a small scene; `path-loss.json` was computed by commit 200df5e."""
    paths = cb.Paths.load(GOLDEN / "paths.h5")
    expected = json.loads((GOLDEN / "path-loss.json").read_text())
    assert set(paths.kind) == set(Kind)
    other = {"stone": cb.Material(6.5, 0.1, 0.2, 0.3, 0.1)}
    for name, loss in {
        "traced materials": path_loss(paths),
        "other materials": path_loss(paths, other),
        "coherent": path_loss(paths, combining="coherent"),
    }.items():
        assert loss == pytest.approx(np.array(expected[name]), rel=1e-12), name
    assert expected["traced materials"] != pytest.approx(np.array(expected["other materials"]), rel=1e-6)
