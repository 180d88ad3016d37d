"""SGWO-IM as a sampler of Optuna."""

import numpy as np
import optuna
import pytest

from calibray.errors import InputError
from calibray.optimizers import SGWOIM, optuna_sampler
from calibray.optimizers.optuna_sampler import SGWOIMSampler

FLOAT, INT = optuna.distributions.FloatDistribution, optuna.distributions.IntDistribution
SPACE = {"a": FLOAT(1.5, 12.0), "b": FLOAT(1.5, 12.0)}
SMALL = {"population": 6, "iterations": 6, "full_iterations": 2, "elites": 2}  # 20 evaluations


@pytest.fixture(autouse=True)
def _quiet():
    optuna.logging.set_verbosity(optuna.logging.ERROR)


@pytest.fixture
def storage(tmp_path):
    """Opens the same database anew at every call; Optuna itself leaves closing to the garbage collector."""
    opened = []

    def again():
        opened.append(optuna.storages.RDBStorage(f"sqlite:///{tmp_path / 'study.db'}"))
        return opened[-1]

    yield again
    for storage in opened:
        storage.remove_session()
        storage.engine.dispose()


def loss(a, b):
    return float((a - 4.0) ** 2 + (b - 7.0) ** 2 + np.sin(3.0 * a))


def objective(trial):
    return loss(trial.suggest_float("a", 1.5, 12.0), trial.suggest_float("b", 1.5, 12.0))


def reference(seed, **settings):
    """Every point of ask and tell, in order."""
    optimizer, points = SGWOIM([1.5, 1.5], [12.0, 12.0], seed=seed, **settings), []
    while not optimizer.done:
        x = optimizer.ask()
        optimizer.tell(x, [loss(*point) for point in x])
        points += x.tolist()
    return points


def points(study):
    return [[trial.params["a"], trial.params["b"]] for trial in study.trials]


def test_a_study_goes_the_way_of_ask_and_tell_and_stops_after_225_evaluations():
    study = optuna.create_study(sampler=SGWOIMSampler(SPACE, seed=4))
    study.optimize(objective)
    assert len(study.trials) == 225
    assert points(study) == reference(4)


def test_a_stored_study_resumes_where_it_stopped(storage):
    study = optuna.create_study(
        storage=storage(), study_name="s", sampler=SGWOIMSampler(SPACE, seed=2, **SMALL)
    )
    study.optimize(objective, n_trials=9)
    again = optuna.load_study(
        storage=storage(), study_name="s", sampler=SGWOIMSampler(SPACE, seed=2, **SMALL)
    )
    again.optimize(objective)
    assert points(again) == reference(2, **SMALL)


def test_a_candidate_lost_with_its_process_is_handed_out_again(storage):
    study = optuna.create_study(
        storage=storage(), study_name="s", sampler=SGWOIMSampler(SPACE, seed=2, **SMALL)
    )
    lost = study.ask(SPACE)  # never told: its process was killed
    again = optuna.load_study(
        storage=storage(), study_name="s", sampler=SGWOIMSampler(SPACE, seed=2, **SMALL)
    )
    again.optimize(objective, n_trials=200)
    finished = [trial for trial in again.trials if trial.number != lost.number]
    assert len(finished) == 20
    assert lost.params in [trial.params for trial in finished]


def test_trials_in_parallel_get_candidates_of_their_own():
    study = optuna.create_study(sampler=SGWOIMSampler(SPACE, seed=3, **SMALL))
    trials = [study.ask(SPACE) for _ in range(6)]
    asked = [[trial.params["a"], trial.params["b"]] for trial in trials]
    assert asked == reference(3, **SMALL)[:6]
    spare = study.ask(SPACE)  # the pack waits for all six
    assert [spare.params["a"], spare.params["b"]] not in asked
    for trial in reversed(trials):
        study.tell(trial, loss(**trial.params))
    following = study.ask(SPACE)
    assert [following.params["a"], following.params["b"]] == reference(3, **SMALL)[6]


def test_a_trial_that_was_enqueued_can_lead_the_pack():
    study = optuna.create_study(sampler=SGWOIMSampler(SPACE, seed=5, **SMALL))
    study.enqueue_trial({"a": 4.0, "b": 7.0})
    study.optimize(objective)
    assert len(study.trials) == 21
    close = [np.hypot(a - 4.0, b - 7.0) for a, b in points(study)]
    assert np.median(close[-8:]) < np.median(close[1:7])
    assert study.best_value <= loss(4.0, 7.0)


def test_a_failed_trial_costs_its_candidate_alone():
    def failing(trial):
        value = objective(trial)
        if trial.params["a"] > 8.0:
            raise RuntimeError("no licence")
        return value

    study = optuna.create_study(sampler=SGWOIMSampler(SPACE, seed=1, **SMALL))
    study.optimize(failing, catch=RuntimeError)
    states = [trial.state.name for trial in study.trials]
    assert len(states) == 20
    assert 0 < states.count("FAIL") < 10


def test_what_is_maximized_is_found_too():
    study = optuna.create_study(direction="maximize", sampler=SGWOIMSampler(SPACE, seed=1, **SMALL))
    study.optimize(lambda trial: -objective(trial))
    assert points(study) == reference(1, **SMALL)


def test_scales_and_whole_numbers_keep_to_their_grid():
    def grid(trial):
        rate = trial.suggest_float("rate", 1e-4, 1.0, log=True)
        steps, width = (
            trial.suggest_int("steps", 2, 8, step=2),
            trial.suggest_float("width", 0.0, 1.0, step=0.25),
        )
        return abs(np.log10(rate) + 2.0) + abs(steps - 6) + abs(width - 0.75)

    space = {
        "rate": FLOAT(1e-4, 1.0, log=True),
        "steps": INT(2, 8, step=2),
        "width": FLOAT(0.0, 1.0, step=0.25),
    }
    study = optuna.create_study(sampler=SGWOIMSampler(space, seed=1))
    study.optimize(grid)
    assert len(study.trials) == 225
    assert {trial.params["steps"] for trial in study.trials} == {2, 4, 6, 8}
    assert {trial.params["width"] for trial in study.trials} == {0.0, 0.25, 0.5, 0.75, 1.0}
    assert study.best_value < 0.3


@pytest.mark.parametrize("grid", [FLOAT(0.0, 1.0, step=0.25), INT(0, 40, step=10), INT(3, 7)])
def test_every_value_of_a_grid_covers_the_same_share_of_the_search_space(grid):
    low, high = optuna_sampler._bounds(grid)
    coordinates = low + (high - low) * (np.arange(500) + 0.5) / 500
    values, counts = np.unique([optuna_sampler._value(grid, x) for x in coordinates], return_counts=True)
    assert values.tolist() == np.linspace(grid.low, grid.high, 5).tolist()
    assert counts.tolist() == [100] * 5


def test_without_a_space_it_is_inferred_and_categories_are_drawn():
    def mixed(trial):
        return objective(trial) + {"x": 0.0, "y": 1.0}[trial.suggest_categorical("kind", ["x", "y"])]

    study = optuna.create_study(sampler=SGWOIMSampler(seed=1, **SMALL))
    study.optimize(mixed)
    assert len(study.trials) == 21  # one at random, to learn the parameters from
    assert {trial.params["kind"] for trial in study.trials} == {"x", "y"}


def test_what_it_cannot_search_is_refused():
    with pytest.raises(InputError, match="neither float nor integer; remove it"):
        SGWOIMSampler({"kind": optuna.distributions.CategoricalDistribution(["x", "y"])})
    with pytest.raises(InputError, match="population = 2"):
        SGWOIMSampler(SPACE, population=2)
    study = optuna.create_study(directions=["minimize"] * 2, sampler=SGWOIMSampler(SPACE))
    with pytest.raises(InputError, match="2 objectives"):
        study.ask(SPACE)


@pytest.mark.parametrize("direction", ["minimize", "maximize"])
def test_infinite_values_count_as_failed_evaluations(direction):
    """Optuna stores them as completed trials, and the study goes on."""
    sign = 1.0 if direction == "minimize" else -1.0

    def some_infinite(trial):
        value = sign * objective(trial)
        return {3: np.inf, 4: -np.inf}.get(trial.number, value)

    study = optuna.create_study(direction=direction, sampler=SGWOIMSampler(SPACE, seed=0, **SMALL))
    study.optimize(some_infinite)
    assert len(study.trials) == 20
