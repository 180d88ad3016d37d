"""Rows that repeat a link count as one measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import planted
from calibray import engines
from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.observed import Observed
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.measurements.observables import Statistic
from calibray.optimizers import LeastSquares
from calibray.paths import take_links
from calibray.study import Setup, Study
from calibray.uncertainty.assessment import average_repeats, certainty
from link_tables import links_from_frame

ROWS = 3
APART_M = 0.002

NOISE_DB = 0.5 * np.random.default_rng(5).standard_normal(planted.LINKS)
ROW_DB = 0.05 * np.random.default_rng(6).standard_normal((planted.LINKS, ROWS))


def problem(rows: int, apart_m: float = APART_M, **sections) -> Problem:
    """A problem with a number of rows per link whose receivers lie some distance apart."""
    frame = planted.links()
    again = frame.loc[np.repeat(frame.index, rows)].reset_index(drop=True)
    again["rx_x"] += apart_m * np.tile(np.arange(rows), len(frame))
    kept = take_links(planted.engine().paths, np.repeat(np.arange(planted.LINKS), rows))
    study = Study.from_content(planted.content("links.csv", **sections))
    setup = Setup.open(study, links=links_from_frame(again))
    measured = np.repeat(planted.path_loss() + NOISE_DB, rows) + ROW_DB[:, :rows].ravel()
    new = Problem.of(setup, engines.Replay(kept, setup.parameters))
    return replace(new, objective=replace(new.objective, measured=measured))


def averaged(rows: Problem) -> Problem:
    return average_repeats(rows, rows.parameters.start)


def offsets(rows: Problem, device: np.ndarray) -> Nuisance:
    """An offset for each of two devices."""
    links = rows.setup.links
    return Nuisance(len(links), (make_term(links, "device", labels=np.where(device, "b", "a")),))


def test_rows_of_one_link_are_replaced_by_their_mean():
    rows = problem(ROWS)
    found = averaged(rows).objective
    counted = found.weight > 0
    assert counted.tolist() == np.tile([True, False, False], planted.LINKS).tolist()
    assert found.weight[counted] == pytest.approx(rows.objective.weight[counted])
    assert found.measured[counted] == pytest.approx(
        rows.objective.measured.reshape(-1, ROWS).mean(axis=1), abs=1e-12
    )


def test_a_row_without_weight_is_not_averaged():
    rows = problem(ROWS)
    weight = np.where(np.arange(len(rows.objective.weight)) % ROWS == 0, 0.0, 1.0)
    lighter = replace(rows, objective=replace(rows.objective, weight=weight))
    found = averaged(lighter).objective
    counted = np.flatnonzero(found.weight)
    assert (counted % ROWS).tolist() == planted.LINKS * [1]
    assert found.measured[counted] == pytest.approx(
        rows.objective.measured.reshape(-1, ROWS)[:, 1:].mean(axis=1), abs=1e-12
    )


@pytest.mark.parametrize("apart_m", [0.02, 5.0])
def test_rows_at_other_positions_stay(apart_m):
    rows = problem(ROWS, apart_m)
    assert averaged(rows) is rows


def test_rows_of_another_group_or_path_loss_stay():
    rows = problem(ROWS)
    device = np.arange(len(rows.objective.weight)) % ROWS == 2
    nuisance = offsets(rows, device)
    grouped = replace(rows, objective=replace(rows.objective, nuisance=nuisance))
    counted = np.flatnonzero(averaged(grouped).objective.weight)
    assert sorted(set((counted % ROWS).tolist())) == [0, 2]
    # Rows at the same positions, but with the paths of other links, as of another antenna.
    found, index = planted.engine(), np.repeat(np.arange(planted.LINKS), ROWS)
    index[ROWS - 1 :: ROWS] = np.roll(np.arange(planted.LINKS), 1)
    other = replace(rows, engine=engines.Replay(take_links(found.paths, index), found.parameters))
    counted = np.flatnonzero(averaged(other).objective.weight)
    assert sorted(set((counted % ROWS).tolist())) == [0, 2]


def test_rows_that_only_the_initial_values_make_equal_stay():
    """Marble and wood are equal at first; the third row of a link meets one in place of the other."""
    equal = {"relative_permittivity": 5.0, "conductivity": 0.01, "thickness": 0.1}
    rows = problem(ROWS, materials={"marble": equal, "wood": equal})
    paths = replace(rows.engine.paths, materials=rows.setup.scene.materials)
    names, third = list(paths.materials), np.arange(len(rows.objective.weight)) % ROWS == 2
    swapped = paths.material.copy()
    marble, wood = names.index("marble"), names.index("wood")
    swapped[paths.material == marble], swapped[paths.material == wood] = wood, marble
    at_third = np.repeat(third[paths.link], np.diff(paths.first))
    paths = replace(paths, material=np.where(at_third, swapped, paths.material))
    rows = replace(rows, engine=engines.Replay(paths, rows.setup.parameters))
    assert set((np.flatnonzero(averaged(rows).objective.weight) % ROWS).tolist()) == {0}
    best = np.array(list(planted.TRUTH.values()))
    assert set((np.flatnonzero(average_repeats(rows, best).objective.weight) % ROWS).tolist()) == {0, 2}


def test_further_observables_of_repeated_rows_are_averaged_and_biases_keep_them_apart():
    rows = problem(ROWS, objective={"no_path": "censor", "ceiling_db": 200.0})
    count, random = len(rows.objective.weight), np.random.default_rng(2)
    spread = np.where(np.arange(count) == 1, np.nan, random.uniform(10, 20, count))
    observable = Observed(
        "spread", Statistic("rms_delay_spread"), spread, 1e-9, np.full(count, -1), (), 1.0, True
    )
    merged = averaged(replace(rows, observed=(observable,)))
    used = merged.observed[0].used(merged.objective.weight)
    assert used.tolist() == list(range(0, count, ROWS))
    expected = np.nanmean(spread.reshape(-1, ROWS), axis=1)
    assert merged.observed[0].measured[used] == pytest.approx(expected, abs=1e-12)
    device = (np.arange(count) % ROWS == 2).astype(np.int64)
    biased = replace(observable, group=device, labels=("a", "b"))
    counted = np.flatnonzero(averaged(replace(rows, observed=(biased,))).objective.weight)
    assert sorted(set((counted % ROWS).tolist())) == [0, 2]


def test_rows_that_a_candidate_leaves_without_a_path_are_averaged_with_each_other():
    rows = problem(ROWS)
    lost = take_links(planted.engine(True).paths, np.repeat(np.arange(planted.LINKS), ROWS))
    rows = replace(rows, engine=engines.Replay(lost, rows.parameters))
    assert np.isinf(rows.modelled(rows.parameters.to_search(rows.parameters.start)[None])).sum() == ROWS
    counted = np.flatnonzero(averaged(rows).objective.weight)
    assert (counted % ROWS).tolist() == planted.LINKS * [0]


def test_intervals_are_those_of_the_means():
    """Negative control: intervals of rows that count as independent are narrower."""
    rows, once = problem(ROWS), problem(1)
    means = rows.objective.measured.reshape(-1, ROWS).mean(axis=1)
    once = replace(once, objective=replace(once.objective, measured=means))
    apart = problem(ROWS, 0.02)
    lower, upper = once.parameters.search_bounds

    def widths(one: Problem) -> np.ndarray:
        intervals = certainty(one, search(one, LeastSquares(lower, upper, starts=16))).record.intervals
        return np.array([interval.upper - interval.lower for interval in intervals.values()])

    reference = widths(once)
    assert widths(rows) == pytest.approx(reference, rel=0.05)
    assert (widths(apart) < 0.9 * reference).any()
