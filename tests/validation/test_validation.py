"""Blocks, the judgement, and the table of held-out errors, on synthetic errors of known size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibray.measurements import Measurements
from calibray.result.held_out import AVERAGE_OF, AVERAGES, WITHOUT_MATERIALS, Model
from calibray.result.wording import choice_text, judgement_text
from calibray.validation.held_out_statistics import (
    MOST_CLUSTERS,
    compare,
    moving_end,
    place_blocks,
    spatial_blocks,
)
from calibray.validation.validation import Validation


def positions(count, seed=0):
    return np.random.default_rng(seed).uniform(0, 500, (count, 3))


def test_blocks_are_even_and_compact():
    position = positions(103)
    block = spatial_blocks(position, 8)
    assert np.ptp(np.bincount(block, minlength=8)) <= 7
    middle = [position[block == k].mean(axis=0) for k in range(8)]
    spread = np.mean([np.linalg.norm(position[block == k] - middle[k], axis=1).mean() for k in range(8)])
    assert spread < 0.7 * np.linalg.norm(position - position.mean(axis=0), axis=1).mean()
    assert np.unique(spatial_blocks(np.zeros((5, 3)), 9)).tolist() == [0, 1, 2, 3, 4]


def test_blocks_follow_the_end_that_moved():
    moved, fixed = positions(60), np.tile([0.0, 0.0, 9.0], (60, 1))
    downlink = Measurements(tx=fixed, rx=moved, path_loss_db=np.full(60, 90.0))
    uplink = Measurements(tx=moved, rx=fixed, path_loss_db=np.full(60, 90.0))
    assert moving_end(downlink) is downlink.rx
    assert moving_end(uplink) is uplink.tx
    assert (place_blocks(moving_end(uplink), 4) == place_blocks(moving_end(downlink), 4)).all()


def test_links_of_one_place_are_in_one_block():
    place = np.random.default_rng(5).integers(0, 14, 100)
    position = positions(14)[place] + np.random.default_rng(6).choice([0.0, 3.0], (100, 1)) * [0, 0, 1]
    block = place_blocks(position, 4)
    assert len(set(zip(place.tolist(), block.tolist(), strict=True))) == len(set(place.tolist()))
    assert len(set(block.tolist())) == 4
    distinct = positions(103)
    assert (place_blocks(distinct, 8) == spatial_blocks(distinct[:, :2], 8)).all()


@pytest.mark.parametrize(
    ("model_db", "law_db", "words"),
    [(2.0, 5.0, "Calibration helped"), (5.0, 2.0, "Calibration did not help")],
)
def test_the_judgement_names_the_best_baseline_and_the_difference(model_db, law_db, words):
    random = np.random.default_rng(1)
    errors = {"worst": 9.0 * random.normal(size=80), "law": law_db * random.normal(size=80)}
    judgement = compare(model_db * random.normal(size=80), errors, positions(80))
    sentence = judgement_text(judgement)
    assert sentence.startswith(words)
    assert "than law, the best baseline" in sentence
    assert f"{abs(judgement.gain_db):.2f} dB" in sentence
    assert judgement.gain_db == pytest.approx(law_db - model_db, abs=1.0)


def test_a_difference_by_chance_is_rarely_called_help():
    random = np.random.default_rng(2)
    helped = [
        compare(random.normal(size=40), {"law": random.normal(size=40)}, positions(40)).helped
        for _ in range(400)
    ]
    assert np.mean(helped) < 0.05  # 0.025 by design, and 0.023 is three standard errors


def test_errors_that_neighbours_share_make_the_difference_less_certain():
    random, position = np.random.default_rng(3), positions(160)
    shared = random.normal(size=40)[spatial_blocks(position, 40)]
    model, law = random.normal(size=(2, 160))
    independent_db = compare(model, {"law": law}, position).error_db
    shared_db = compare(model, {"law": shared}, position).error_db
    assert shared_db > 1.2 * independent_db


def test_one_held_out_link_has_no_bootstrap_error():
    """A result with such a judgement is stored and read again, so the error must be a finite number or None."""
    judgement = compare(np.array([1.0]), {"law": np.array([2.0])}, positions(1))
    assert judgement.error_db is None
    assert not judgement.helped
    assert "one cluster" in judgement_text(judgement)


def test_many_links_are_resampled_in_a_limited_number_of_clusters():
    model, law = np.random.default_rng(6).normal(size=(2, 6000))
    judgement = compare(model, {"law": 1.1 * law}, positions(6000))
    assert judgement.clusters == MOST_CLUSTERS
    assert judgement.error_db == pytest.approx(np.sqrt(1 + 1.1**2) / np.sqrt(2 * 6000), rel=0.15)


def synthetic_validation(scales, count=400, seed=4):
    """A validation of models whose errors have known standard deviations [dB]."""
    random = np.random.default_rng(seed)
    position = positions(count)
    errors = {name: size * random.normal(size=count) for name, size in scales.items()}
    return Validation(
        tuple("abcd"), spatial_blocks(position[:, :2], 4), errors, position, np.full(count, 100.0)
    )


def test_the_table_has_rmse_log_density_and_coverage():
    validation = synthetic_validation({Model.INITIAL: 6.0, Model.CALIBRATED: 3.0, Model.LOG_DISTANCE: 8.0})
    row = validation.table.loc[Model.CALIBRATED]
    assert row.rmse_db == pytest.approx(3.0, rel=0.1)
    assert row.coverage == pytest.approx(0.9, abs=0.04)
    assert row.log_density == pytest.approx(-0.5 - np.log(3 * np.sqrt(2 * np.pi)), abs=0.1)
    assert validation.best == Model.CALIBRATED
    assert validation.nested_rmse_db == pytest.approx(row.rmse_db)
    assert validation.sentence.startswith("Calibration helped")
    assert validation.content()["models"][Model.LOG_DISTANCE]["rmse_db"] == pytest.approx(8.0, rel=0.1)
    assert "4 blocks held out in turn, 400 links" in repr(validation)


def test_intervals_from_other_blocks_do_not_cover_a_block_that_differs():
    """Negative control: coverage can fail."""
    validation = synthetic_validation({Model.INITIAL: 6.0, Model.CALIBRATED: 3.0})
    wide = np.where(validation.block == 0, 4.0, 1.0) * validation.errors[Model.CALIBRATED]
    uneven = replace(validation, errors={**validation.errors, Model.CALIBRATED: wide})
    assert uneven.table.loc[Model.CALIBRATED, "coverage"] < 0.85


def test_choosing_by_the_other_blocks_costs_accuracy_where_blocks_disagree():
    validation = synthetic_validation({Model.INITIAL: 3.0, Model.CALIBRATED: 3.0})
    even = validation.block % 2 == 0
    errors = {Model.INITIAL: np.where(even, 1.0, 9.0), Model.CALIBRATED: np.where(even, 9.0, 1.0)}
    opposed = replace(validation, errors=errors)
    assert opposed.nested_rmse_db >= opposed.table["rmse_db"].min() - 1e-9
    # The other blocks always choose the model that fails on the block that is held out.
    assert opposed.nested_rmse_db == pytest.approx(9.0)


def test_a_calibrated_model_is_chosen_only_if_it_is_clearly_better():
    near = synthetic_validation(
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
        "The chosen model is 'initial materials'. The model 'calibrated' is better on held-out blocks, but "
        "by too little to be preferred."
    )
    assert near.choice in near.summary()[2]
    assert near.content()["chosen"] == Model.INITIAL
    # With many links the bootstrap standard error is small, and a gain of 3 % is certain but too small.
    base = synthetic_validation({Model.INITIAL: 3.0, Model.CALIBRATED: 3.0}).errors[Model.INITIAL]
    scaled = replace(
        near, errors={Model.INITIAL: base, Model.CALIBRATED: 0.97 * base}, block=np.zeros(len(base), int)
    )
    scaled = replace(scaled, position=np.arange(3.0 * len(base)).reshape(-1, 3))
    assert scaled.chosen == Model.INITIAL
    assert (
        replace(scaled, errors={Model.INITIAL: base, Model.CALIBRATED: 0.9 * base}).chosen == Model.CALIBRATED
    )
    clear = synthetic_validation(
        {
            Model.INITIAL: 6.0,
            Model.PRIOR: 5.0,
            Model.CALIBRATED: 2.0,
            Model.LOG_DISTANCE: 9.0,
            Model.RESIDUAL_FIELD: 1.9,
        }
    )
    assert clear.chosen == Model.CALIBRATED
    assert clear.choice == "The chosen model is 'calibrated', the best on held-out blocks."


def test_the_log_distance_model_is_chosen_where_it_is_clearly_better():
    far = synthetic_validation({Model.INITIAL: 9.0, Model.CALIBRATED: 8.0, Model.LOG_DISTANCE: 2.0})
    assert far.chosen == Model.LOG_DISTANCE
    assert far.choice == "The chosen model is 'log-distance', the best on held-out blocks."
    near = synthetic_validation(
        {Model.INITIAL: 9.0, Model.CALIBRATED: 2.1, Model.LOG_DISTANCE: 2.0}, count=40, seed=3
    )
    assert near.table.loc[Model.LOG_DISTANCE, "rmse_db"] < near.table.loc[Model.CALIBRATED, "rmse_db"]
    assert near.chosen == Model.CALIBRATED
    assert near.choice == (
        "The chosen model is 'calibrated'. The model 'log-distance' is better on held-out blocks, but "
        "by too little to be preferred."
    )


@pytest.mark.parametrize(
    ("best", "partner", "average"),
    [
        (Model.INITIAL, Model.PRIOR, Model.AVERAGE_INITIAL),
        (Model.CALIBRATED, Model.PRIOR, Model.AVERAGE_CALIBRATED),
        (Model.PRIOR, Model.CALIBRATED, Model.AVERAGE_CALIBRATED),
        (Model.OFFSETS, Model.CALIBRATED, Model.AVERAGE_OFFSETS),
        (Model.LOG_DISTANCE, Model.PRIOR, Model.AVERAGE_LOG_DISTANCE),
        (Model.OBSTRUCTION, Model.PRIOR, Model.AVERAGE_OBSTRUCTION),
    ],
)
def test_the_average_of_the_chosen_model_and_a_second_one_predicts(best, partner, average):
    average_db = 1.5 if best in WITHOUT_MATERIALS else 3.0
    size_db = dict.fromkeys((Model.INITIAL, Model.CALIBRATED, Model.PRIOR, Model.OFFSETS, best), 9.0)
    validation = synthetic_validation(
        size_db | dict.fromkeys(AVERAGES, 9.0) | {best: 2.0, average: average_db}
    )
    assert validation.chosen == average
    assert validation.nested_rmse_db == pytest.approx(average_db, rel=0.1)
    assert (
        f"The chosen model is the average of the models {str(best)!r} and {str(partner)!r}"
        in validation.choice
    )
    assert f"The model {str(best)!r} is preferred, as the best on held-out blocks." in validation.choice
    # Not a second sentence that names one model.
    assert validation.choice.count("The chosen model is") == 1
    assert set(validation.table.index) == {*map(str, size_db), str(average)}


def test_the_text_of_an_average_names_both_of_its_models():
    """Another model is the best, and is no part of the average."""
    text = choice_text(Model.OFFSETS, Model.CALIBRATED, Model.PRIOR)
    assert (
        f"The chosen model is the average of the models {str(Model.OFFSETS)!r} and {str(Model.PRIOR)!r}"
        in text
    )
    # The difference can be significant, and the judgement then says that calibration helped.
    assert (
        f"{str(Model.CALIBRATED)!r} is better on held-out blocks, but by too little to be preferred." in text
    )


@pytest.mark.parametrize("best", WITHOUT_MATERIALS)
def test_a_log_distance_model_is_not_averaged_if_that_is_worse(best):
    sizes = dict.fromkeys((Model.INITIAL, Model.CALIBRATED, Model.PRIOR, *AVERAGES), 9.0)
    validation = synthetic_validation(sizes | {best: 2.0, AVERAGE_OF[best]: 2.5})
    assert validation.chosen == best
    assert "averag" not in validation.choice


def test_the_one_standard_error_rule_beats_the_lowest_rmse_on_few_links():
    rmse_db, by_rule, by_rmse = {Model.INITIAL: 3.0, Model.CALIBRATED: 3.3, Model.OFFSETS: 3.6}, [], []
    for seed in range(60):
        validation = synthetic_validation(rmse_db, count=24, seed=seed)
        by_rule.append(rmse_db[validation.chosen])
        by_rmse.append(rmse_db[validation.best])
    assert np.mean(by_rule) < np.mean(by_rmse) - 0.05
