"""Selection of links near the noise floor by predicted path loss, which gives unbiased fits."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import planted
from calibray.calibration.calibrate import calibrate
from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.objective import make_objective
from calibray.fitting.preliminary_fits import MARGIN, leave_out_near_floor
from calibray.fitting.problem import Problem
from calibray.measurements import (
    Averaging,
    LinkColumns,
    Measurements,
    Preparation,
    SourceTable,
    measured_links,
)
from calibray.parameters import Parameter, Parameters
from calibray.study import Setup
from calibray.uncertainty.joint_model import joint_model

STONE = Parameter("stone.relative_permittivity", 1.5, 12.0, 8.0)
SLOPE, SPREAD_DB, LIMIT_DB = 5.0, 2.0, 115.0
WAY = np.tile(np.linspace(0.0, 10.0, 60), 3)


@dataclass
class Ramp:
    """An engine whose path loss rises along a route by a parameter."""

    way: np.ndarray
    calls: int = 0
    large: bool = False
    interactions: int = 0
    materials: dict = field(default_factory=dict)
    parameters: Parameters = field(default_factory=lambda: Parameters((STONE,)))

    def path_loss(self, candidates):
        return 80.0 + candidates * self.way

    def path_loss_and_jacobian(self, candidates):
        slope = np.repeat(self.way[None, :, None], len(candidates), axis=0)
        return self.path_loss(candidates), slope


def measured(seed: int, spread_db: float = SPREAD_DB) -> Problem:
    """A problem over the links above the noise floor."""
    loss = 80.0 + SLOPE * WAY + spread_db * np.random.default_rng(seed).standard_normal(len(WAY))
    way, loss = WAY[loss < LIMIT_DB], loss[loss < LIMIT_DB]
    place = np.column_stack([way, np.zeros((len(way), 2))])
    links = Measurements(tx=place + 1.0, rx=place, path_loss_db=loss, limit_db=np.full(len(way), LIMIT_DB))
    engine = Ramp(way)
    nuisance = Nuisance(len(way), (make_term(links, "offset"),))
    objective = make_objective(links, np.ones(len(way), bool), np.ones(len(way), bool), nuisance=nuisance)
    before = engine.path_loss(engine.parameters.start[None])[0]
    return Problem(SimpleNamespace(links=links), engine, objective, before)  # type: ignore[arg-type]


def slope(problem: Problem) -> float:
    """The best slope with an offset, in closed form."""
    there = problem.objective.weight > 0
    return float(np.polyfit(problem.engine.way[there], problem.objective.measured[there], 1)[0])  # type: ignore[attr-defined]


def test_selection_by_measurement_is_biased_and_by_prediction_is_not():
    every = [measured(seed) for seed in range(40)]
    chosen = [leave_out_near_floor(problem) for problem in every]
    all_heard, expected = (np.array([slope(each) for each in problems]) for problems in (every, chosen))
    errors = [slopes.std(ddof=1) / np.sqrt(len(every)) for slopes in (all_heard, expected)]
    assert all_heard.mean() < SLOPE - 4 * errors[0]
    assert abs(expected.mean() - SLOPE) < 3 * errors[1]
    one = chosen[0]
    assert one.faint is not None
    assert np.array_equal(one.faint, one.objective.weight == 0)
    # Those left out are expected beyond the limit less the margin, by the fit to those left.
    model = 80.0 + SLOPE * one.setup.links.rx[:, 0]
    assert model[one.faint].min() == pytest.approx(LIMIT_DB - MARGIN * SPREAD_DB, abs=2.0)


def test_large_errors_leave_half_the_margin_instead_of_all_links(caplog):
    """No link is eight standard deviations of 5.5 dB above the floor, a third of them four: the slope is unbiased."""
    every = [measured(seed, 5.5) for seed in range(40)]
    chosen = [leave_out_near_floor(problem) for problem in every]
    received, expected = (np.array([slope(each) for each in problems]) for problems in (every, chosen))
    errors = [slopes.std(ddof=1) / np.sqrt(len(every)) for slopes in (received, expected)]
    assert received.mean() < SLOPE - 4 * errors[0]
    assert abs(expected.mean() - SLOPE) < 3 * errors[1]
    assert not caplog.messages


def test_without_a_floor_or_far_above_it_all_links_are_used():
    problem = measured(0)
    links = problem.setup.links
    for limit in (None, np.full(len(links), 300.0)):
        other = SimpleNamespace(links=Measurements(links.tx, links.rx, links.path_loss_db, limit_db=limit))
        kept = leave_out_near_floor(Problem(other, problem.engine, problem.objective, problem.before))  # type: ignore[arg-type]
        assert kept.faint is None
        assert kept.objective.num_counted == len(links)


def test_links_stay_if_all_are_faint():
    problem = measured(1)
    links = problem.setup.links
    limit = np.full(len(links), 60.0)
    other = SimpleNamespace(links=Measurements(links.tx, links.rx, links.path_loss_db, limit_db=limit))
    kept = leave_out_near_floor(Problem(other, problem.engine, problem.objective, problem.before))  # type: ignore[arg-type]
    assert kept.objective.num_counted == len(links)


def test_a_group_with_only_faint_links_keeps_all_of_them_with_a_warning(caplog):
    """Its offset, fitted to the received half of a group at the floor, is too low by 0.8 standard deviations."""
    random, way = np.random.default_rng(4), np.tile(np.linspace(0.0, 2.0, 60), 3)
    weak = np.arange(len(way)) % 2 == 0
    loss = 80.0 + SLOPE * way + np.where(weak, LIMIT_DB - 80.0 - SLOPE * way, 0.0)
    loss += SPREAD_DB * random.standard_normal(len(way))
    way, weak, loss = (values[loss < LIMIT_DB] for values in (way, weak, loss))
    place = np.column_stack([way, np.zeros((len(way), 2))])
    limit = np.full(len(way), LIMIT_DB)
    links = Measurements(place + 1.0, place, loss, group=np.where(weak, "weak", "strong"), limit_db=limit)
    columns = (make_term(links, "offset", labels=links.group),)
    every = np.ones(len(way), bool)
    engine = Ramp(np.where(weak, 0.0, way))
    objective = make_objective(links, every, every, nuisance=Nuisance(len(way), columns))
    before = engine.path_loss(engine.parameters.start[None])[0]
    kept = leave_out_near_floor(Problem(SimpleNamespace(links=links), engine, objective, before))  # type: ignore[arg-type]
    assert kept.objective.num_counted == len(way)
    found = kept.objective.coefficients(engine.path_loss(np.array([[SLOPE]])))[0]
    assert found == pytest.approx([0.0, LIMIT_DB - 80.0 - 0.8 * SPREAD_DB], abs=0.6)
    (message,) = caplog.messages
    assert f"{weak.sum()} of {len(way)} links are expected near the noise floor" in message
    assert "do not determine offset[weak]" in message
    assert "weak links are received only if fading is favourable" in message


@pytest.mark.parametrize(
    ("quantity", "sent", "limit"), [("rsrp", None, 120.0), ("received_power", 30.0, 150.0)]
)
def test_the_floor_is_a_limit_of_path_loss(quantity, sent, limit):
    rows = SourceTable(pd.DataFrame({"x": [0.0, 40.0], "y": 0.0, "z": 1.5, "p": [-80.0, -119.0]}))
    steps = Preparation(noise_floor_dbm=-120.0)
    columns = LinkColumns((5.0, 5.0, 9.0), ("x", "y", "z"), "p", quantity, tx_power_dbm=sent)
    links = measured_links(rows, columns, steps)
    assert links.limit_db is not None
    assert links.limit_db.tolist() == [limit, limit]
    assert links.select(np.array([True, False])).limit_db == pytest.approx([limit])


def test_the_logarithm_of_a_mean_of_few_samples_is_unbiased():
    """Rayleigh fading about -80 dBm, ten samples per cell: the logarithm of their mean is 0.22 dB too low."""
    rng = np.random.default_rng(5)
    power = 1e-8 * rng.exponential(size=(4000, 10))
    rows = {"x": np.repeat(10.0 * np.arange(4000), 10), "y": 0.0, "z": 1.5, "p": 10 * np.log10(power.ravel())}
    for unbiased, off in ((False, -0.219), (True, 0.0)):
        steps = Preparation(averaging=Averaging("cell", 5.0, unbiased=unbiased))
        columns = LinkColumns((9.0, 9.0, 9.0), ("x", "y", "z"), "p", "rsrp")
        links = measured_links(SourceTable(pd.DataFrame(rows)), columns, steps)
        # The standard error is 0.022 dB, and higher orders leave some hundredths.
        assert 80.0 - links.path_loss_db.mean() == pytest.approx(off, abs=0.09)


def test_censored_links_inform_intervals_but_not_the_rmse(tmp_path):
    """A street with a third of the links below the floor; intervals cover the truth."""
    table = planted.campaign(noise_db=0.3)
    floor = float(-table["path_loss_db"].quantile(0.67))
    table = table.assign(power=np.where(-table["path_loss_db"] > floor, -table["path_loss_db"], np.nan))
    links = {
        "file": "links.csv", "tx": list(planted.COLUMNS[:3]), "rx": list(planted.COLUMNS[3:]), "value": "power",
        "quantity": "received_power", "tx_power_dbm": 0.0, "noise_floor_dbm": floor, "below_floor": "censor",
    }  # fmt: skip
    method = {"name": "auto", "options": {"starts": 64}}
    found = calibrate(planted.study(tmp_path, table, links=links, method=method), engine=planted.engine())
    missing = table["power"].isna().to_numpy()
    assert found.links["censored"].to_numpy(bool).tolist() == missing.tolist()
    assert found.links["faint"].to_numpy(bool)[missing].all()
    assert found.provenance.rows["at or below the noise floor, treated as censored"] == missing.sum() == 4
    assert found.counts["calibrated_on"] <= 8
    held = [
        interval.pieces[0][0] <= planted.TRUTH[name] <= interval.pieces[-1][1]
        for name, interval in found.intervals.items()
    ]
    assert all(held)
    problem = Problem.of(Setup.open(planted.study(tmp_path, table, links=links)), planted.engine())
    best = problem.parameters.to_search(np.array(list(planted.TRUTH.values())))
    explaining = joint_model(problem, best, 0.3**2, 5)
    assert explaining.marginal.censored.tolist() == missing.tolist()
    kinds = {model.kind for model in explaining.marginal.models}
    assert "correlated" not in kinds
