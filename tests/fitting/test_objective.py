"""The objective against the paper's formula, a closed form, dense least squares and finite differences."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import lsq_linear, minimize

import two_ray
from calibray.engines import Replay
from calibray.errors import InputError
from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.objective import Objective, make_objective
from calibray.fitting.preliminary_fits import LEAST_NOISE_DB, estimate_noise
from calibray.fitting.problem import Problem
from calibray.measurements import Measurements, SourceTable
from calibray.study import Setup, Study

LINKS = 30


def campaign(groups: bool = True) -> Measurements:
    """Measured links with weights and a column of clutter, optionally in three groups."""
    rng = np.random.default_rng(5)
    return Measurements(
        tx=np.zeros((LINKS, 3)),
        rx=rng.uniform(10, 200, (LINKS, 3)),
        path_loss_db=rng.uniform(80, 120, LINKS),
        weight=rng.uniform(0.2, 3.0, LINKS),
        group=np.array(["a", "b", "c"])[np.arange(LINKS) % 3] if groups else None,
        table=SourceTable(pd.DataFrame({"clutter_m": rng.uniform(0, 40, LINKS)}), source="links.csv"),
    )


def objective(
    *terms: dict, groups: bool = True, calibrated: np.ndarray | None = None, **options
) -> Objective:
    """The objective over all or some links, with terms of a nuisance."""
    links, everything = campaign(groups), np.ones(LINKS, dtype=bool)
    made = tuple(
        make_term(
            links, **{"name": f"term{k}", **term, "labels": links.group if term.get("labels") else None}
        )
        for k, term in enumerate(terms)
    )
    return make_objective(
        links,
        everything,
        everything if calibrated is None else calibrated,
        nuisance=Nuisance(LINKS, made),
        **options,
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


OFFSET = {"name": "offset"}
OFFSETS = {"name": "offset", "labels": True}
SLOPE = {"name": "slope", "by": "log_distance"}
SLOPES = {"name": "slope", "by": "log_distance", "labels": True}
CLUTTER = {"name": "clutter", "by": "clutter_m"}

TIGHT = {"bounds": (-0.3, 0.3)}
DESIGNS = {
    "none": (),
    "offset": (OFFSET,),
    "offsets": (OFFSETS,),
    "offsets in bounds": ({**OFFSETS, **TIGHT},),
    "offsets with a prior": ({**OFFSETS, "prior": 2.0},),
    "offsets and slope": (OFFSETS, SLOPE),
    "offsets and slopes": (OFFSETS, SLOPES, CLUTTER),
    "both in bounds": ({**OFFSETS, **TIGHT}, {**SLOPES, "bounds": (-1.0, 1.5)}),
    "slope in bounds over groups": ({**OFFSETS, **TIGHT}, {**SLOPE, "bounds": (-40.0, 40.0)}),
    "groups borrow": (OFFSET, {**OFFSETS, "name": "each", "prior": 1.5}, {**SLOPE, "prior": 4.0}),
    "all at once": (
        OFFSET,
        {**OFFSETS, "name": "each", "prior": 1.5, **TIGHT},
        {**SLOPES, "bounds": (-2.0, 2.0), "prior": 4.0},
        {**CLUTTER, "bounds": (0.0, 0.1)},
    ),
}


@pytest.fixture(params=DESIGNS)
def design(request):
    """The terms of a design."""
    return DESIGNS[request.param]


def built(terms: tuple[dict, ...], **options) -> Objective:
    """The objective of a design, with 3 dB of noise."""
    return objective(*terms, noise_db=3.0, **options)


@dataclass(frozen=True)
class Former:
    """Offsets per group in closed form."""

    measured: np.ndarray
    weight: np.ndarray
    group: np.ndarray
    num_groups: int
    bounds: tuple[float, float]
    ceiling_db: float | None

    def offsets(self, path_loss: np.ndarray) -> np.ndarray:
        gap = self.measured - self.capped(path_loss)
        weight = np.where(np.isfinite(gap), self.weight, 0.0)
        total = self.per_group(weight)
        mean = self.per_group(weight * np.where(weight > 0, gap, 0.0)) / np.where(total > 0, total, 1.0)
        return np.clip(mean, *self.bounds)

    def residuals(self, path_loss: np.ndarray) -> np.ndarray:
        counted = self.weight > 0
        fitted = self.capped(path_loss) + self.offsets(path_loss)[:, self.group]
        return (fitted - self.measured)[:, counted] * self.scale()[counted]

    def jacobian(self, path_loss: np.ndarray, derivative: np.ndarray) -> np.ndarray:
        counted = self.weight > 0
        flat = path_loss >= (np.inf if self.ceiling_db is None else self.ceiling_db)
        slope = np.where((flat | ~counted)[..., None], 0.0, derivative)
        offset = self.offsets(path_loss)
        free = (offset > self.bounds[0]) & (offset < self.bounds[1])
        total = self.per_group(self.weight[None])
        mean = np.stack([self.per_group(self.weight * slope[..., k]) for k in range(slope.shape[2])], axis=-1)
        mean = mean / np.where(total > 0, total, 1.0)[..., None] * free[..., None]
        return (slope - mean[:, self.group])[:, counted] * self.scale()[counted][:, None]

    def capped(self, path_loss: np.ndarray) -> np.ndarray:
        return path_loss if self.ceiling_db is None else np.minimum(path_loss, self.ceiling_db)

    def scale(self) -> np.ndarray:
        return np.sqrt(self.weight * (self.weight > 0).sum() / self.weight.sum())

    def per_group(self, value: np.ndarray) -> np.ndarray:
        return np.stack([value[:, self.group == k].sum(axis=1) for k in range(self.num_groups)], axis=1)


@pytest.mark.parametrize("ceiling", [None, 101.0])
@pytest.mark.parametrize("bounds", [None, (-20.0, 20.0), (-0.5, 0.5), (1.0, 1.5)])
@pytest.mark.parametrize("groups", [False, True])
@pytest.mark.parametrize("calibrated", [np.arange(LINKS) >= 0, np.arange(LINKS) % 3 != 1])
def test_an_offset_per_group_agrees_with_the_closed_form(groups, bounds, ceiling, calibrated):
    term = {**OFFSETS, "bounds": bounds} if groups else {**OFFSET, "bounds": bounds}
    target = objective(term, groups=groups, calibrated=calibrated, ceiling_db=ceiling)
    links = campaign(groups)
    former = Former(
        links.path_loss_db,
        np.where(calibrated, links.weight, 0.0),
        links.group_index,
        len(links.group_names),
        bounds or (-np.inf, np.inf),
        ceiling,
    )
    loss, slope = model(np.random.default_rng(3).normal(size=(6, 2)))
    loss[1, [2, 7]] = loss[2, 7] = loss[3, links.group_index == 0] = np.inf
    close = {"rel": 1e-12, "abs": 1e-12}
    assert target.coefficients(loss) == pytest.approx(former.offsets(loss), **close)
    assert target.residuals(loss) == pytest.approx(former.residuals(loss), **close)
    assert target.jacobian(loss, slope) == pytest.approx(former.jacobian(loss, slope), **close)


def test_the_rmse_is_that_of_the_paper():
    target, (loss, _) = objective(groups=False), model(np.zeros((1, 2)))
    links = campaign(groups=False)
    assert target.rmse(loss)[0] == pytest.approx(weighted_rmse(loss[0] - links.path_loss_db, links.weight))
    assert np.mean(target.residuals(loss) ** 2) == pytest.approx(target.rmse(loss)[0] ** 2)
    assert target.value(loss).tolist() == target.rmse(loss).tolist()
    unweighted = replace(target, weight=np.ones(LINKS))
    assert unweighted.rmse(loss)[0] == pytest.approx(np.sqrt(np.mean((loss[0] - links.path_loss_db) ** 2)))


def test_links_without_weight_have_no_effect(design):
    calibrated = np.arange(LINKS) < 20
    target, (loss, slope) = built(design, calibrated=calibrated), model(np.ones((2, 2)))
    changed = np.where(calibrated, loss, np.inf)
    assert target.rmse(changed) == pytest.approx(target.rmse(loss))
    assert target.jacobian(changed, slope).tolist() == target.jacobian(loss, slope).tolist()
    priors = np.isfinite(target.nuisance.prior).sum()
    assert target.residuals(loss).shape == (2, 20 + priors)
    moved = np.where(np.arange(LINKS) == 3, loss + 1.0, loss)
    assert target.rmse(moved) != pytest.approx(target.rmse(loss))


def augmented(target: Objective, loss: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The dense least-squares problem of the coefficients, weights and priors as rows."""
    counted = target.weight > 0
    weight = target.weight[counted] * counted.sum() / target.weight.sum()
    rows = target.nuisance.design.toarray()[counted] * np.sqrt(weight)[:, None]
    ridge = np.diag(3.0 / target.nuisance.prior)
    gap = (target.measured - loss)[counted] * np.sqrt(weight)
    return np.concatenate([rows, ridge]), np.concatenate([gap, np.zeros(len(ridge))])


def test_coefficients_agree_with_the_dense_problem(design):
    target, (loss, _) = built(design), model(np.random.default_rng(1).normal(size=(5, 2)))
    if not design:
        assert target.coefficients(loss).shape == (5, 0)
        return
    for row, found in zip(loss, target.coefficients(loss), strict=True):
        matrix, side = augmented(target, row)
        reference = lsq_linear(
            matrix, side, (target.nuisance.lower, target.nuisance.upper), tol=1e-14, method="bvls"
        )
        assert found == pytest.approx(reference.x, abs=1e-9)
        # The conditions of the minimum: no pull inside the bounds, none inwards at them.
        pull = matrix.T @ (side - matrix @ found)
        lower, upper = found <= target.nuisance.lower, found >= target.nuisance.upper
        assert pull[~lower & ~upper] == pytest.approx(0.0, abs=1e-9)
        assert (pull[lower] <= 0).all()
        assert (pull[upper] >= 0).all()


def test_the_coefficients_minimise_the_value(design):
    target, (loss, _) = built(design), model(np.zeros((1, 2)))
    matrix, side = augmented(target, loss[0])
    left = matrix @ target.coefficients(loss)[0] - side
    priors = np.isfinite(target.nuisance.prior)
    rows = LINKS + priors.sum()
    assert target.value(loss)[0] == pytest.approx(np.sqrt(left @ left / rows))
    assert target.rmse(loss)[0] == pytest.approx(np.sqrt(left[:LINKS] @ left[:LINKS] / LINKS))
    assert (target.rmse(loss)[0] == pytest.approx(target.value(loss)[0])) == (not priors.any())


def test_derivatives_agree_with_finite_differences(design):
    target = built(design, calibrated=np.arange(LINKS) % 7 != 0)
    at = np.array([[0.3, 0.9], [-1.0, 2.0]])
    check_derivatives(target, at)
    if any("bounds" in term for term in design):
        found = target.coefficients(model(at)[0])
        lower, upper = target.nuisance.lower, target.nuisance.upper
        assert ((found == lower) | (found == upper)).any(), "no bound is active"
    if design:
        plain = replace(target, nuisance=Nuisance(LINKS))
        exact = target.jacobian(*model(at))[:, : (target.weight > 0).sum()]
        assert plain.jacobian(*model(at)) != pytest.approx(exact, abs=1e-3)


def test_derivatives_under_a_ceiling_agree_with_finite_differences():
    check_derivatives(objective(OFFSETS, SLOPE, ceiling_db=101.0), np.array([[0.3, 0.9], [-1.0, 2.0]]))


def check_derivatives(target: Objective, at: np.ndarray) -> None:
    """Compare the Jacobian with central differences of the residuals."""
    exact, step = target.jacobian(*model(at)), 1e-6
    for k in range(2):
        ahead, behind = at + step * np.eye(2)[k], at - step * np.eye(2)[k]
        numeric = (target.residuals(model(ahead)[0]) - target.residuals(model(behind)[0])) / (2 * step)
        assert exact[..., k] == pytest.approx(numeric, abs=1e-6)


@pytest.mark.parametrize("name", ["offsets", "offsets and slope", "groups borrow"])
def test_fitting_with_the_nuisance_eliminated_equals_a_joint_fit(name):
    target = built(DESIGNS[name])
    columns = len(target.nuisance.columns)

    def full(unknown: np.ndarray) -> float:
        matrix, side = augmented(target, model(unknown[None, :2])[0][0])
        return float(np.mean((matrix @ unknown[2:] - side) ** 2))

    def reduced(unknown: np.ndarray) -> float:
        residuals = target.residuals(model(unknown[None])[0])[0]
        return float(residuals @ residuals / (LINKS + columns))

    joint = minimize(full, np.zeros(2 + columns), method="BFGS", options={"gtol": 1e-9})
    alone = minimize(reduced, np.zeros(2), method="BFGS", options={"gtol": 1e-9})
    assert alone.fun == pytest.approx(joint.fun, abs=1e-8)
    assert alone.x == pytest.approx(joint.x[:2], abs=1e-3)
    assert target.coefficients(model(alone.x[None])[0])[0] == pytest.approx(joint.x[2:], abs=1e-3)


def test_a_ceiling_censors_before_the_offset():
    target, (loss, slope) = objective(OFFSET, groups=False, ceiling_db=100.0), model(np.zeros((1, 2)))
    lost = np.where(np.arange(LINKS) % 5 == 0, np.inf, loss)
    assert target.model(lost) == pytest.approx(np.minimum(lost, 100.0) + target.coefficients(lost))
    assert np.isfinite(target.rmse(lost)).all()
    assert target.capped(lost).max() == 100.0
    plain = objective(groups=False, ceiling_db=100.0).jacobian(lost, slope)
    assert (plain[0, lost[0] >= 100.0] == 0).all()
    assert (plain[0, lost[0] < 100.0] != 0).all()


def test_undetermined_columns_are_marked():
    target = objective(OFFSETS, SLOPES, calibrated=np.arange(LINKS) % 3 != 1)
    assert dict(zip(target.nuisance.columns, target.determined.tolist(), strict=True)) == {
        "offset[a]": True,
        "offset[b]": False,
        "offset[c]": True,
        "slope[a]": True,
        "slope[b]": False,
        "slope[c]": True,
    }
    assert target.supported.tolist() == (np.arange(LINKS) % 3 != 1).tolist()
    found = target.coefficients(model(np.zeros((1, 2)))[0])[0]
    assert (found != 0).tolist() == target.determined.tolist()
    # One link tells the offset of its group, and no slope beside it.
    one = objective(OFFSETS, SLOPES, calibrated=(np.arange(LINKS) % 3 != 1) | (np.arange(LINKS) == 1))
    assert one.determined.tolist() == [True, True, True, True, False, True]
    assert one.residuals(model(np.zeros((1, 2)))[0])[0, 1] == pytest.approx(0.0, abs=1e-12)
    assert not one.supported[4]
    # A prior gives a number to a group that no link tells, but that is not the data's.
    prior = built(({**OFFSETS, "prior": 2.0},), calibrated=np.arange(LINKS) % 3 != 1)
    assert prior.determined.tolist() == [True, False, True]
    assert objective().determined.tolist() == []
    assert objective().supported.all()


def test_a_candidate_that_loses_links_is_not_fitted_to_them():
    target, (loss, _) = objective(OFFSETS, SLOPE), model(np.ones((3, 2)))
    loss[1, :4], loss[2, 9] = np.inf, np.nan
    found = target.coefficients(loss)
    for row, coefficients in zip(loss, found, strict=True):
        fewer = replace(target, weight=np.where(np.isfinite(row), target.weight, 0.0))
        assert coefficients == pytest.approx(fewer.coefficients(row[None])[0], abs=1e-12)
    assert np.isfinite(target.rmse(loss)).tolist() == [True, False, False]


def test_no_calibration_link_is_refused():
    links, nothing = campaign(), np.zeros(LINKS, dtype=bool)
    with pytest.raises(
        InputError, match=r"no path reaches any of the 30 calibration links; raise trace.max_depth"
    ):
        make_objective(links, nothing, ~nothing)
    assert make_objective(links, nothing, ~nothing, ceiling_db=120.0).weight.tolist() == links.weight.tolist()


def test_a_nuisance_of_other_links_is_refused():
    links, everything = campaign(), np.ones(LINKS, dtype=bool)
    with pytest.raises(InputError, match="the nuisance has 7 links, must have 30"):
        make_objective(links, everything, everything, nuisance=Nuisance(7))
    term = make_term(links, "offset", prior=3.0)
    with pytest.raises(InputError, match="a prior requires noise_db"):
        make_objective(links, everything, everything, nuisance=Nuisance(LINKS, (term,)))


def test_errors_of_held_out_links_do_not_scale_priors(tmp_path):
    """The posterior mean of an offset: sum of gap / std^2 over (sum of 1 / std^2 + 1 / prior^2)."""
    study = two_ray.study(
        tmp_path, offset={"bounds": [-50.0, 50.0], "prior_db": 1.0}, holdout={"where": 'half == "odd"'}
    )
    table = pd.read_csv(tmp_path / "links.csv")
    std = np.where(table["half"] == "odd", 20.0, 4.0)
    table.assign(std=std, path_loss_db=table["path_loss_db"] + 5.0).to_csv(
        tmp_path / "links.csv", index=False
    )
    content = study.content()
    content["links"]["std"] = "std"
    setup = Setup.open(Study.from_content(content, study.path), two_ray.TwoRay)
    problem = Problem.of(setup, Replay(setup.trace(), setup.parameters, "coherent"))
    loss = problem.modelled(problem.parameters.to_search([two_ray.TRUTH])[None])
    assert problem.objective.noise_db == pytest.approx(4.0)
    precision = 15 / 4.0**2
    assert problem.objective.coefficients(loss) == pytest.approx(
        5.0 * precision / (precision + 1.0), rel=1e-6
    )


def test_measurements_that_equal_the_model_have_the_least_noise(tmp_path):
    study = two_ray.study(tmp_path, offset={"bounds": [-9.0, 9.0], "prior_db": 2.0})
    setup = Setup.open(study, two_ray.TwoRay)
    problem = Problem.of(setup, Replay(setup.trace(), setup.parameters, "coherent"))
    problem = replace(problem, objective=replace(problem.objective, measured=problem.before))
    assert problem.squares(problem.parameters.to_search(problem.parameters.start)[None]).rmse_db == 0.0
    assert estimate_noise(problem).objective.noise_db == LEAST_NOISE_DB


def test_other_weights_keep_the_error_of_every_link():
    whole = replace(objective(), noise_db=3.0)
    fewer = whole.reweighted(np.where(np.arange(LINKS) < 5, whole.weight, 0.0))
    variance = [it.noise_db**2 * it.weight[it.weight > 0].mean() / it.weight[0] for it in (whole, fewer)]
    assert variance[1] == pytest.approx(variance[0])
    assert not whole.reweighted(np.zeros(LINKS)).weight.any()
