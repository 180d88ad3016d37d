"""The objective against numerical optima and finite differences, intervals against theory and simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import t

from calibray.errors import EngineError, InputError
from calibray.inference.likelihood import LogDistance, Objective, intervals, make_objective
from calibray.measurements import Measurements

LINKS = 30


def campaign(groups: bool = True) -> Measurements:
    """Measured links with weights of their own, in three groups if asked for."""
    rng = np.random.default_rng(5)
    return Measurements(
        tx=np.zeros((LINKS, 3)),
        rx=rng.uniform(10, 200, (LINKS, 3)),
        path_loss_db=rng.uniform(80, 120, LINKS),
        weight=rng.uniform(0.2, 3.0, LINKS),
        group=np.array(["a", "b", "c"])[np.arange(LINKS) % 3] if groups else None,
    )


def objective(groups: bool = True, calibrated: np.ndarray | None = None, **options) -> Objective:
    """The objective over all its links, or some."""
    everything = np.ones(LINKS, dtype=bool)
    return make_objective(
        campaign(groups), everything, everything if calibrated is None else calibrated, **options
    )


def model(candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A smooth model of two parameters: path loss [n, L] and derivatives [n, L, 2]."""
    rng = np.random.default_rng(8)
    base, a, b = (
        campaign().path_loss_db + rng.normal(0, 4, LINKS),
        rng.normal(0, 3, LINKS),
        rng.uniform(0, 5, LINKS),
    )
    x, y = candidates[:, :1], candidates[:, 1:]
    return base + a * x + b * np.sin(y), np.stack([a + 0 * x, b * np.cos(y)], axis=-1)


def weighted_rmse(gap: np.ndarray, weight: np.ndarray) -> float:
    """The paper's RMSE with weights, written out."""
    return float(np.sqrt(np.sum(weight * gap**2) / np.sum(weight)))


def test_the_rmse_is_that_of_the_paper():
    target, (loss, _) = objective(groups=False), model(np.zeros((1, 2)))
    links = campaign(groups=False)
    assert target.rmse(loss)[0] == pytest.approx(weighted_rmse(loss[0] - links.path_loss_db, links.weight))
    assert np.mean(target.residuals(loss) ** 2) == pytest.approx(target.rmse(loss)[0] ** 2)
    unweighted = replace(target, weight=np.ones(LINKS))
    assert unweighted.rmse(loss)[0] == pytest.approx(np.sqrt(np.mean((loss[0] - links.path_loss_db) ** 2)))


def test_links_that_do_not_count_leave_no_trace():
    calibrated = np.arange(LINKS) < 20
    target, (loss, slope) = objective(calibrated=calibrated, offset=True), model(np.ones((2, 2)))
    changed = np.where(calibrated, loss, np.inf)
    assert target.rmse(changed) == pytest.approx(target.rmse(loss))
    assert target.jacobian(changed, slope).tolist() == target.jacobian(loss, slope).tolist()
    assert target.residuals(loss).shape == (2, 20)
    moved = np.where(np.arange(LINKS) == 3, loss + 1.0, loss)
    assert target.rmse(moved) != pytest.approx(target.rmse(loss))


@pytest.mark.parametrize("bounds", [None, (-20.0, 20.0), (-0.5, 0.5), (1.0, 1.5)])
@pytest.mark.parametrize("groups", [False, True])
def test_offsets_in_closed_form_are_the_numerical_optimum(groups, bounds):
    target, (loss, _) = objective(groups, offset=True, bounds=bounds), model(np.full((1, 2), 0.7))
    links = campaign(groups)
    for k, name in enumerate(links.group_names):
        mine = links.group_index == k
        found = minimize_scalar(
            lambda shift, mine=mine: np.sum(
                links.weight[mine] * (loss[0] + shift - links.path_loss_db)[mine] ** 2
            ),
            bounds=bounds or (-50, 50),
            method="bounded",
            options={"xatol": 1e-9},
        )
        assert target.offsets(loss)[0, k] == pytest.approx(found.x, abs=1e-5), name
    plain = replace(target, num_groups=0)
    assert target.rmse(loss)[0] <= plain.rmse(loss)[0] or bounds == (1.0, 1.5)


def test_an_offset_of_links_that_are_all_held_out_is_zero():
    target = objective(calibrated=np.arange(LINKS) % 3 != 1, offset=True)
    offset = target.offsets(model(np.zeros((1, 2)))[0])[0]
    assert offset[1] == 0.0
    assert (offset[[0, 2]] != 0.0).all()


@pytest.mark.parametrize(
    "options", [{}, {"offset": True}, {"offset": True, "bounds": (-0.3, 0.3)}, {"ceiling_db": 101.0}]
)
def test_derivatives_with_offsets_eliminated_are_the_finite_differences(options):
    target = objective(calibrated=np.arange(LINKS) % 7 != 0, **options)
    at = np.array([[0.3, 0.9], [-1.0, 2.0]])
    exact, step = target.jacobian(*model(at)), 1e-6
    for k in range(2):
        ahead, behind = at + step * np.eye(2)[k], at - step * np.eye(2)[k]
        numeric = (target.residuals(model(ahead)[0]) - target.residuals(model(behind)[0])) / (2 * step)
        assert exact[..., k] == pytest.approx(numeric, abs=1e-6)
    raw = replace(target, num_groups=0, ceiling_db=None).jacobian(*model(at))
    assert (raw != pytest.approx(exact, abs=1e-3)) == bool(options)


def test_fitting_with_offsets_eliminated_is_fitting_them_too():
    target, links = objective(offset=True), campaign()

    def full(unknown: np.ndarray) -> float:
        gap = model(unknown[None, :2])[0][0] + unknown[2:][links.group_index] - links.path_loss_db
        return weighted_rmse(gap, links.weight)

    joint = minimize(full, np.zeros(5), method="BFGS", options={"gtol": 1e-9})
    reduced = minimize(
        lambda x: target.rmse(model(x[None])[0])[0], np.zeros(2), method="BFGS", options={"gtol": 1e-9}
    )
    assert reduced.fun == pytest.approx(joint.fun, abs=1e-8)
    assert reduced.x == pytest.approx(joint.x[:2], abs=1e-4)
    assert target.offsets(model(reduced.x[None])[0])[0] == pytest.approx(joint.x[2:], abs=1e-4)


def test_a_ceiling_censors_before_the_offset():
    target, (loss, slope) = objective(groups=False, offset=True, ceiling_db=100.0), model(np.zeros((1, 2)))
    lost = np.where(np.arange(LINKS) % 5 == 0, np.inf, loss)
    assert target.model(lost) == pytest.approx(np.minimum(lost, 100.0) + target.offsets(lost))
    assert np.isfinite(target.rmse(lost)).all()
    assert target.capped(lost).max() == 100.0
    plain = objective(groups=False, ceiling_db=100.0).jacobian(lost, slope)
    assert (plain[0, lost[0] >= 100.0] == 0).all()
    assert (plain[0, lost[0] < 100.0] != 0).all()


def test_no_link_to_calibrate_on_is_refused():
    links, nothing = campaign(), np.zeros(LINKS, dtype=bool)
    with pytest.raises(
        InputError, match=r"no path leads to any of 30 links to calibrate on; raise trace.max_depth"
    ):
        make_objective(links, nothing, ~nothing)
    assert make_objective(links, nothing, ~nothing, ceiling_db=120.0).weight.tolist() == links.weight.tolist()


def linear_problem(noise: np.ndarray, offset: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares of y = D theta (+ c) + noise: optimum [d], residuals [m], Jacobian without c [m, d]."""
    design = np.random.default_rng(2).normal(size=(len(noise), 2)) @ np.array([[3.0, 1.0], [0.0, 0.4]]) + 1.0
    slope = design - design.mean(axis=0) if offset else design
    y = design @ TRUTH + noise - (noise.mean() + (design @ TRUTH).mean() if offset else 0.0)
    best, *_ = np.linalg.lstsq(slope, y, rcond=None)
    return best, slope @ best - y, slope


TRUTH = np.array([4.0, 5.0])
LOWER, UPPER = np.zeros(2), np.full(2, 10.0)


@pytest.mark.parametrize("offset", [False, True])
def test_intervals_of_a_linear_problem_are_the_textbook_ones(offset):
    best, residuals, slope = linear_problem(np.random.default_rng(1).normal(0, 0.5, 25), offset)
    found = intervals(best, residuals, slope, LOWER, UPPER, nuisances=int(offset))
    variance = residuals @ residuals / (25 - 2 - offset)
    errors = np.sqrt(np.diag(variance * np.linalg.inv(slope.T @ slope)))
    assert [interval.standard_error for interval in found] == pytest.approx(errors)
    reach = t.ppf(0.975, 25 - 2 - offset)
    assert [interval.upper for interval in found] == pytest.approx(best + reach * errors)
    assert [interval.lower for interval in found] == pytest.approx(best - reach * errors)


def coverage(noise: np.ndarray, factor: float = 1.0) -> np.ndarray:
    """How often the interval, its width times a factor, holds the truth [d], over many campaigns [n, m]."""
    hits = np.zeros(2)
    for sample in noise:
        found = intervals(*linear_problem(sample, True), LOWER, UPPER, nuisances=1)
        middle = np.array([(each.lower + each.upper) / 2 for each in found])
        half = np.array([(each.upper - each.lower) / 2 for each in found])
        hits += abs(middle - TRUTH) <= factor * half
    return hits / len(noise)


def test_intervals_cover_the_truth_95_times_in_100():
    # Few links, so that Student's t matters (1.96 would cover 89 %); the simulation's own error is 0.4 %.
    independent = np.random.default_rng(4).normal(0, 0.5, (4000, 9))
    assert coverage(independent) == pytest.approx(0.95, abs=0.01)
    assert (coverage(independent, factor=0.5) < 0.75).all()
    # What linear theory promises fails where neighbouring links share their error, as the docstring warns.
    shared = np.repeat(np.random.default_rng(4).normal(0, 0.5, (1000, 3)), 10, axis=1)
    order = np.argsort(np.random.default_rng(2).normal(size=(30, 2))[:, 0])
    assert coverage(shared[:, np.argsort(order)]).min() < 0.8


def verdicts(slope: np.ndarray, best: np.ndarray = TRUTH, noise: float = 0.5) -> list[str]:
    """Verdicts at an optimum, with residuals of a given size."""
    residuals = noise * np.where(np.arange(len(slope)) % 2, 1.0, -1.0)
    return [each.verdict for each in intervals(best, residuals, slope, LOWER, UPPER, nuisances=0)]


def test_verdicts_tell_what_the_data_can():
    sharp = np.random.default_rng(3).normal(size=(40, 2))
    assert verdicts(sharp) == ["identified", "identified"]
    assert verdicts(sharp * [1.0, 0.01]) == ["identified", "not identifiable"]
    assert verdicts(sharp * [1.0, 0.0]) == ["identified", "not identifiable"]
    assert verdicts(sharp[:, [0, 0]]) == ["not identifiable", "not identifiable"]  # they trade off
    assert verdicts(sharp, np.array([0.0, 10.0])) == ["at bound", "at bound"]
    assert verdicts(sharp, noise=50.0) == ["not identifiable", "not identifiable"]


def test_intervals_end_at_the_bounds():
    sharp = np.random.default_rng(3).normal(size=(40, 2))
    found = intervals(np.array([0.0, 9.9]), np.full(40, 0.5), sharp, LOWER, UPPER, nuisances=0)
    assert found[0].lower == 0.0 < found[0].upper
    assert found[1].upper == 10.0 > found[1].lower
    blind = intervals(TRUTH, np.full(40, 0.5), sharp * [1.0, 0.0], LOWER, UPPER, nuisances=0)
    assert (blind[1].lower, blind[1].upper) == (0.0, 10.0)


def test_a_log_distance_law_is_recovered_exactly():
    distance = np.geomspace(5, 500, 20)
    loss, weight = 38.5 + 27.0 * np.log10(distance), np.random.default_rng(0).uniform(0.1, 2, 20)
    law = LogDistance.fit(distance, loss, weight)
    assert (law.intercept_db, law.slope_db) == pytest.approx((38.5, 27.0))
    assert law.path_loss(np.array([1.0, 10.0])) == pytest.approx([38.5, 65.5])
    spoilt = np.where(np.arange(20) == 4, loss + 30, loss)
    left_out = LogDistance.fit(distance, spoilt, np.where(np.arange(20) == 4, 0.0, weight))
    assert left_out.slope_db == pytest.approx(27.0)
    weighted = LogDistance.fit(distance, spoilt, weight)
    reference = np.polyfit(np.log10(distance), spoilt, 1, w=np.sqrt(weight))
    assert (weighted.slope_db, weighted.intercept_db) == pytest.approx(tuple(reference))
    assert weighted.slope_db != pytest.approx(27.0, abs=0.1)


def test_a_log_distance_law_needs_two_links():
    with pytest.raises(EngineError, match="at least two links"):
        LogDistance.fit(np.array([5.0, 9.0]), np.array([80.0, 90.0]), np.array([1.0, 0.0]))
