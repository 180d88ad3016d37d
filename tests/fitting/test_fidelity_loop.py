"""The fidelity loop: the gap after tracing again, and repeated calibration by auto."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

import planted
from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.fitting.fidelity_loop import with_interpolation_error
from calibray.fitting.nuisance import Nuisance
from calibray.fitting.objective import Objective
from calibray.paths import take
from calibray.reporting.wording import prediction_text
from calibray.tracing.settings import TraceSettings
from calibray.tracing.trace_plan import plan_trace


def stronger(decibels):
    """The planted paths, stronger by some dB."""
    paths = planted.engine().paths
    return replace(paths, spreading=paths.spreading * 10 ** (decibels / 20))


class StandIn:
    """A fake tracer: returns prepared paths in order, then the last ones repeatedly."""

    versions: ClassVar[dict[str, str]] = {"stand-in": "1"}

    def __init__(self, *paths):
        self.given, self.asked = paths, 0

    def __call__(self, *_):
        return self

    def plan(self, links):
        return plan_trace(links.tx, TraceSettings(samples=1, max_depth=1), 1000, 0)

    def trace(self, links, progress=None, materials=None):
        self.asked += 1
        return self.given[min(self.asked, len(self.given)) - 1]

    def enclosed(self, points):
        return np.zeros(len(points), dtype=bool)


@pytest.fixture(autouse=True)
def _no_cache(monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")


def run(folder, gains, method="auto", tracer=None, **sections):
    """Calibrate on the planted paths, later traces stronger by `gains` [dB]; returns result and number of traces."""
    sampled = {"max_depth": 2, "samples": 20_000, "line_of_sight": False, "refraction": True}
    study = planted.study(folder, planted.campaign(), trace=sampled, **sections)
    options = {"starts": 8} if method == "auto" else {}
    study = study.model_copy(
        update={"method": study.method.model_copy(update={"name": method, "options": options})}
    )
    tracer = tracer or StandIn(*map(stronger, gains))
    engine = engines.Replay(planted.engine().paths, planted.engine().parameters)
    return calibrate(study, engine=engine, tracer=tracer), tracer.asked


def test_unchanged_paths_leave_no_gap_and_are_traced_once(tmp_path):
    result, asked = run(tmp_path, [0.0])
    assert asked == 1
    assert result.fit.retrace_gap_db == pytest.approx(0, abs=1e-9)


def test_the_gap_is_the_change_of_path_loss(tmp_path):
    result, _ = run(tmp_path, [0.25])
    assert result.fit.retrace_gap_db == pytest.approx(0.25, abs=1e-9)
    np.testing.assert_allclose(result.links["retrace_gap_db"], -0.25, atol=1e-9)
    # Predictions and exports trace anew, so their path loss contains the gap.
    for name in ("predicted_db", "scene_db"):
        np.testing.assert_allclose(result.links[name] - result.links["after_db"], -0.25, atol=1e-9)


def test_auto_calibrates_again_until_the_paths_are_stable(tmp_path):
    # The paths change once, then stay.
    result, asked = run(tmp_path, [0.8])
    assert asked == 2
    assert result.fit.retrace_gap_db == pytest.approx(0, abs=1e-9)


def test_rounds_bound_the_loop_and_zero_switches_it_off(tmp_path):
    gains = [0.8, 1.6, 2.4, 3.2, 4.0]
    result, asked = run(tmp_path, gains, fidelity={"rounds": 2})
    assert asked == 2
    assert result.fit.retrace_gap_db > 0.5
    result, asked = run(tmp_path, gains, fidelity={"rounds": 0})
    assert (result.fit.retrace_gap_db, asked) == (None, 0)


def test_a_method_with_a_budget_does_not_calibrate_again(tmp_path):
    result, asked = run(tmp_path, [0.8], "sgwo-im")
    assert (result.rt_calls, asked) == (225, 1)
    assert result.fit.retrace_gap_db == pytest.approx(0.8, abs=1e-9)


def test_a_link_lost_by_the_new_trace_is_left_out_and_reported(tmp_path):
    paths = stronger(0.8)
    kept = take(paths, np.flatnonzero(paths.link != 3))
    result, _ = run(tmp_path, [], tracer=StandIn(kept), offset={"bounds": [-5.0, 5.0]})
    assert not result.links["has_path"][3]
    assert result.links["has_path"].sum() == planted.LINKS - 1
    assert np.isfinite(result.rmse_db)
    assert np.isfinite(result.fit.retrace_gap_db)


def test_a_ceiling_predicts_a_link_lost_by_the_new_trace(tmp_path):
    kept = take(stronger(0.0), np.flatnonzero(stronger(0.0).link != 3))
    ceiling = {"no_path": "censor", "ceiling_db": 150.0}
    result, _ = run(tmp_path, [], tracer=StandIn(kept), fidelity={"rounds": 1}, objective=ceiling)
    assert np.isinf(result.links["retrace_gap_db"][3])
    # As `predict` does at a link without a path.
    assert result.links["predicted_db"][3] == 150.0
    assert result.prediction.fallback is None
    assert "log-distance" not in prediction_text(result)


def test_links_whose_interpolation_errs_count_less():
    random = np.random.default_rng(3)
    residual, gap = random.normal(0.0, 2.0, 400), np.where(np.arange(400) < 100, 6.0, 0.0)
    stated = np.ones(400)
    stated[:2], gap[2] = 0.0, np.inf
    objective = Objective(residual, stated, Nuisance(400, ()), noise_db=2.0)
    weighted = with_interpolation_error(objective, np.zeros(400), gap)
    counted = stated > 0
    counted[2] = False
    # The median of squares of a normal variable is 0.455 times its variance.
    variance = np.median(residual[counted] ** 2) / 0.45494
    assert variance == pytest.approx(4.0, rel=0.2)
    assert not weighted.weight[:2].any()
    np.testing.assert_allclose(weighted.weight[3:100], variance / (variance + 36.0), rtol=1e-4)
    np.testing.assert_array_equal(weighted.weight[100:], 1.0)
    # The error of a link without a gap stays 2 dB.
    assert weighted.noise_db**2 * weighted.weight[counted].mean() == pytest.approx(4.0)
