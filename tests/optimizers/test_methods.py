"""Declarations of the methods, and optimizers made by name."""

from inspect import signature

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.optimizers import GWO, METHODS, SGWOIM, LeastSquares, Optimizer, make, method
from problem_families.landscapes import rosenbrock

LANDSCAPE = rosenbrock()
BOX = (LANDSCAPE.lower, LANDSCAPE.upper)
DECLARED = {"uses", "schedule", "takes_starts"}
CASES = sorted(METHODS.items())


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_a_method_declares_what_its_constructor_takes(name, kind):
    settings = set(signature(kind).parameters)
    assert kind.takes_starts == ({"x0", "starts"} <= settings)
    assert ("objective" in settings) == ("residuals" in kind.uses)
    assert kind.needs_derivatives() == (name == "least-squares")
    assert set(kind.within(225)) <= settings
    assert (kind.schedule is None) == (make(name, *BOX).budget is None)


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_a_method_is_final_and_overrides_only_declarations(name, kind):
    assert kind.__final__
    interface = {name for name in vars(Optimizer) if not name.startswith("_")}
    for parent in kind.__mro__[: kind.__mro__.index(Optimizer)]:
        assert set(vars(parent)) & interface <= DECLARED


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_every_budget_from_the_smallest_on_is_kept(name, kind):
    if kind.schedule is None:
        assert kind.within(1) == {}
        return
    for budget in (*range(kind.schedule.least, kind.schedule.least + 12), 89, 225, 601):
        used = make(name, *BOX, budget=budget).budget
        full = 30 if kind is GWO else 5 if kind is SGWOIM else 1
        assert budget - full < used <= budget
    with pytest.raises(InputError, match=f"budget = .*needs at least {kind.schedule.least} evaluation"):
        make(name, *BOX, budget=kind.schedule.least - 1)


def test_a_budget_too_small_for_the_surrogate_is_to_be_raised():
    with pytest.raises(InputError, match=r"15 samples; .* 20 parameters needs at least 21: raise the budget"):
        make("sgwo-im", np.zeros(20), np.ones(20), budget=24)


def test_the_papers_schedules():
    assert SGWOIM.within(225) == {"population": 30, "elites": 5, "iterations": 20}
    assert GWO.within(600) == {"population": 30, "iterations": 20}
    assert SGWOIM(*BOX).budget == 225
    assert GWO(*BOX).budget == 600


def test_options_override_budget_and_starts():
    assert make("gwo", *BOX, budget=90, options={"iterations": 2}).budget == 60
    optimizer = make("least-squares", *BOX, start=[0.5, 0.5], starts=4)
    assert isinstance(optimizer, LeastSquares)
    assert len(optimizer.ask()) == 5
    assert np.array_equal(optimizer.ask()[0], [0.5, 0.5])
    assert len(make("least-squares", *BOX, start=[0.5, 0.5], starts=4, options={"starts": 8}).ask()) == 9


@pytest.mark.parametrize("name", sorted(set(METHODS) - {"least-squares"}))
def test_a_start_has_no_effect_on_a_method_that_takes_none(name):
    one, other = make(name, *BOX, 3), make(name, *BOX, 3, start=[0.5, 0.5], starts=4)
    assert np.array_equal(one.ask(), other.ask())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "gwoo"}, "method 'gwoo': there is no such method; did you mean 'gwo'"),
        (
            {"name": "gwo", "options": {"wolfes": 3}},
            "method.options of 'gwo': there is no setting 'wolfes'; use one of: iterations",
        ),
        ({"name": "gwo", "options": {"iteration": 3}}, "setting 'iteration'; did you mean 'iterations'"),
        ({"name": "gwo", "options": {"seed": 3}}, "there is no setting 'seed'"),
        ({"name": "least-squares", "options": {"objective": 3}}, "there is no setting 'objective'"),
    ],
)
def test_unknown_methods_and_settings_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        make(lower=[0.0], upper=[1.0], **arguments)


def test_a_method_is_looked_up_by_its_name():
    assert method("sgwo-im") is SGWOIM
