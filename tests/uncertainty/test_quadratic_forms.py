"""Densities of gaps with one model each, against the densities under all models."""

from dataclasses import replace

import numpy as np
import pytest

from calibray.uncertainty import joint_model as module
from calibray.uncertainty.joint_model import QuadraticForms
from calibray.uncertainty.noise_models import Marginal, NoiseModel, noise_models

LINKS, COUNT = 30, 120


def _marginal(columns, censored=None, further=None):
    random = np.random.default_rng(1)
    position = random.uniform(0, 300, (LINKS, 3))
    models = list(noise_models(position, censored=censored is not None, out_of_sight=censored is None))
    if further:
        models.append(further)
    if censored is not None:
        models = [model for model in models if model.kind != "correlated"]
    return Marginal.of(
        random.standard_normal((LINKS, columns)),
        np.array([0.0, 0.3])[:columns],  # the first is flat
        random.uniform(0.8, 1.2, LINKS),
        position,
        3.0,
        models,
        censored,
        random.normal(15, 8, LINKS),
    )


def _asked(marginal, seed=2):
    random = np.random.default_rng(seed)
    gap = 3.0 * random.standard_normal((COUNT, LINKS)) + 15.0 * (random.random((COUNT, LINKS)) < 0.1)
    gap[3, 4] = np.inf
    return gap, random.integers(0, len(marginal.models), COUNT)


@pytest.mark.parametrize("columns", [0, 2])
@pytest.mark.parametrize("most", [module.MAX_LINKS, LINKS - 1])
def test_each_density_is_that_of_its_model(columns, most, monkeypatch):
    monkeypatch.setattr(module, "MAX_LINKS", most)
    marginal = _marginal(columns)
    gap, model = _asked(marginal)
    forms = QuadraticForms.of(marginal)
    assert bool(forms.square) == (most >= LINKS)
    found, wanted = forms.densities(gap, model), marginal.densities(gap)[np.arange(COUNT), model]
    assert np.isneginf(found[3])
    there = np.arange(COUNT) != 3
    assert found[there] == pytest.approx(wanted[there], abs=1e-3)


def test_a_kind_without_quadratic_form_uses_the_density_of_its_model():
    """The recipe for a noise model requires a density, and no change of the quadratic forms."""
    marginal = _marginal(2, further=NoiseModel("logistic", 0.1))
    gap, _ = _asked(marginal)
    forms, last = QuadraticForms.of(marginal), len(marginal.models) - 1
    assert [form is None for form in forms.square] == [
        model.kind in ("student-t", "logistic") for model in marginal.models
    ]
    found, wanted = forms.densities(gap, np.full(COUNT, last)), marginal.densities(gap)[:, last]
    assert np.delete(found, 3) == pytest.approx(np.delete(wanted, 3))


def test_censored_links_use_the_full_density():
    censored = np.arange(LINKS) % 5 == 0
    marginal = _marginal(1, censored)
    gap, model = _asked(marginal)
    wanted = marginal.densities(gap)[np.arange(COUNT), model]
    found = QuadraticForms.of(marginal).densities(gap, model)
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(wanted))
    assert np.delete(found, 3) == pytest.approx(np.delete(wanted, 3), abs=1e-4)


def test_a_single_kind_of_model_works():
    marginal = _marginal(0)
    heavy = replace(marginal, models=tuple(model for model in marginal.models if model.kind == "student-t"))
    gap, model = _asked(heavy)
    wanted = heavy.densities(gap)[np.arange(COUNT), model]
    found = QuadraticForms.of(heavy).densities(gap, model)
    assert np.delete(found, 3) == pytest.approx(np.delete(wanted, 3), abs=1e-3)
