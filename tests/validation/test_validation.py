"""Blocks, the sentence, and the table of held-out errors, on made-up errors whose size is known."""

from __future__ import annotations

import numpy as np
import pytest

from calibray.result.held_out import Model
from calibray.result.wording import judgement_text
from calibray.validation.blocks import blocks
from calibray.validation.judgement import MOST_CLUSTERS, compare
from calibray.validation.validation import Validation


def places(count, seed=0):
    return np.random.default_rng(seed).uniform(0, 500, (count, 3))


def test_blocks_are_even_and_compact():
    position = places(103)
    found = blocks(position, 8)
    assert np.ptp(np.bincount(found, minlength=8)) <= 7
    middle = [position[found == k].mean(axis=0) for k in range(8)]
    spread = np.mean([np.linalg.norm(position[found == k] - middle[k], axis=1).mean() for k in range(8)])
    assert spread < 0.7 * np.linalg.norm(position - position.mean(axis=0), axis=1).mean()
    assert np.unique(blocks(np.zeros((5, 3)), 9)).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("mine", "other", "words"),
    [(2.0, 5.0, "Calibration helped"), (5.0, 2.0, "Calibration did not help")],
)
def test_the_sentence_names_the_best_rival_and_the_difference(mine, other, words):
    random = np.random.default_rng(1)
    errors = {"worst": 9.0 * random.normal(size=80), "law": other * random.normal(size=80)}
    found = compare(mine * random.normal(size=80), errors, places(80))
    sentence = judgement_text(found)
    assert sentence.startswith(words)
    assert "than law, the best baseline" in sentence
    assert f"{abs(found.gain_db):.2f} dB" in sentence
    assert found.gain_db == pytest.approx(other - mine, abs=1.0)


def test_chance_is_seldom_called_help():
    random = np.random.default_rng(2)
    found = [
        compare(random.normal(size=40), {"law": random.normal(size=40)}, places(40)).helped
        for _ in range(400)
    ]
    assert np.mean(found) < 0.05  # 0.025 by design, and 0.023 is three standard errors


def test_errors_that_neighbours_share_make_the_difference_less_sure():
    random, position = np.random.default_rng(3), places(160)
    shared = random.normal(size=40)[blocks(position, 40)]
    own, law = random.normal(size=(2, 160))
    alone = compare(own, {"law": law}, position).error_db
    together = compare(own, {"law": shared}, position).error_db
    assert together > 1.2 * alone


def test_many_links_are_resampled_in_no_more_clusters_than_memory_holds():
    own, law = np.random.default_rng(6).normal(size=(2, 6000))
    found = compare(own, {"law": 1.1 * law}, places(6000))
    assert found.clusters == MOST_CLUSTERS
    assert found.error_db == pytest.approx(np.sqrt(1 + 1.1**2) / np.sqrt(2 * 6000), rel=0.15)


def made(scales, count=400, seed=4):
    """Errors of models of known size."""
    random = np.random.default_rng(seed)
    position = places(count)
    errors = {name: size * random.normal(size=count) for name, size in scales.items()}
    return Validation(tuple("abcd"), blocks(position[:, :2], 4), errors, position)


def test_the_table_tells_size_density_and_coverage():
    found = made({Model.INITIAL: 6.0, Model.CALIBRATED: 3.0, Model.LOG_DISTANCE: 8.0})
    row = found.table.loc[Model.CALIBRATED]
    assert row.rmse_db == pytest.approx(3.0, rel=0.1)
    assert row.coverage == pytest.approx(0.9, abs=0.04)
    assert row.log_density == pytest.approx(-0.5 - np.log(3 * np.sqrt(2 * np.pi)), abs=0.1)
    assert found.best == Model.CALIBRATED
    assert found.nested_rmse_db == pytest.approx(row.rmse_db)
    assert found.sentence.startswith("Calibration helped")
    assert found.content()["models"][Model.LOG_DISTANCE]["rmse_db"] == pytest.approx(8.0, rel=0.1)
    assert "4 blocks held out in turn, 400 links" in repr(found)


def test_intervals_taken_from_other_blocks_do_not_cover_one_that_differs():
    """Negative control: coverage is earned."""
    found = made({Model.INITIAL: 6.0, Model.CALIBRATED: 3.0})
    wide = np.where(found.block == 0, 4.0, 1.0) * found.errors[Model.CALIBRATED]
    odd = Validation(found.labels, found.block, {**found.errors, Model.CALIBRATED: wide}, found.position)
    inside = odd.table.loc[Model.CALIBRATED, "coverage"]
    assert inside < 0.85


def test_choosing_by_the_other_blocks_costs_where_models_take_turns():
    found = made({Model.INITIAL: 3.0, Model.CALIBRATED: 3.0})
    turns = found.block % 2 == 0
    errors = {Model.INITIAL: np.where(turns, 1.0, 9.0), Model.CALIBRATED: np.where(turns, 9.0, 1.0)}
    taken = Validation(found.labels, found.block, errors, found.position)
    assert taken.nested_rmse_db >= taken.table["rmse_db"].min() - 1e-9
    assert taken.nested_rmse_db == pytest.approx(
        9.0
    )  # each block speaks for the model that fails on the others


def test_calibration_has_to_earn_its_place():
    """A little better than the materials as they were says nothing; much better does."""
    near = made(
        {
            Model.INITIAL: 3.0,
            Model.PRIOR: 2.98,
            Model.CALIBRATED: 2.97,
            Model.LOG_DISTANCE: 9.0,
            Model.KRIGING: 0.5,
        },
        count=60,
        seed=6,
    )
    assert near.table.loc[Model.CALIBRATED, "rmse_db"] < near.table.loc[Model.INITIAL, "rmse_db"]
    assert near.chosen == Model.INITIAL
    assert near.best == Model.KRIGING
    assert near.choice == (
        "Predictions use the model 'initial materials': it keeps the initial materials and is worse than 'calibrated' "
        "by no more than the bootstrap error."
    )
    assert near.choice in near.summary()[2]
    assert near.content()["chosen"] == Model.INITIAL
    clear = made(
        {
            Model.INITIAL: 6.0,
            Model.PRIOR: 5.0,
            Model.CALIBRATED: 2.0,
            Model.LOG_DISTANCE: 9.0,
            Model.RESIDUAL_FIELD: 1.9,
        }
    )
    assert clear.chosen == Model.CALIBRATED
    assert clear.choice == "Predictions use the model 'calibrated', the best on held-out blocks."


def test_the_law_is_chosen_where_no_twin_comes_near():
    far = made({Model.INITIAL: 9.0, Model.CALIBRATED: 8.0, Model.LOG_DISTANCE: 2.0})
    assert far.chosen == Model.LOG_DISTANCE
    assert far.choice == "Predictions use the model 'log-distance', the best on held-out blocks."
    near = made({Model.INITIAL: 9.0, Model.CALIBRATED: 2.1, Model.LOG_DISTANCE: 2.0}, count=40, seed=3)
    assert near.table.loc[Model.LOG_DISTANCE, "rmse_db"] < near.table.loc[Model.CALIBRATED, "rmse_db"]
    assert near.chosen == Model.CALIBRATED
    assert "it uses the scene and is worse than 'log-distance'" in near.choice


def test_choosing_by_the_best_alone_is_worse_where_calibration_is():
    """A few links seldom tell models that are nearly as good: what the rule is for."""
    size, ruled, leading = {Model.INITIAL: 3.0, Model.CALIBRATED: 3.3, Model.SLOPE: 3.6}, [], []
    for seed in range(60):
        found = made(size, count=24, seed=seed)
        ruled.append(size[found.chosen])
        leading.append(size[found.best])
    assert np.mean(ruled) < np.mean(leading) - 0.05
