"""Tracing again with the materials found: the gap is measured, and auto calibrates again while it is too large."""

from dataclasses import replace

import numpy as np
import pytest

import planted
from calibray import engines
from calibray.calibration.calibration import calibrate
from calibray.paths import take


def stronger(decibels):
    """A stand-in for the tracer: the planted paths, all stronger by so many dB."""
    paths = planted.engine().paths
    return replace(paths, spreading=paths.spreading * 10 ** (decibels / 20))


@pytest.fixture
def retraced(monkeypatch):
    """Gains [dB] of the traces that the next calls will give; the last one repeats. Records how many were asked for."""
    gains, asked = [0.0], []

    def trace(*_):
        asked.append(gains[min(len(asked), len(gains) - 1)])
        return stronger(asked[-1])

    monkeypatch.setattr(engines, "traced_paths", trace)
    return gains, asked


def run(folder, method="auto", **sections):
    sampled = {"max_depth": 2, "samples": 20_000, "line_of_sight": False, "refraction": True}
    study = planted.study(folder, planted.campaign(), trace=sampled, **sections)
    options = {"starts": 8} if method == "auto" else {}
    study = study.model_copy(
        update={"method": study.method.model_copy(update={"name": method, "options": options})}
    )
    return calibrate(study, engine=engines.Replay(planted.engine().paths, planted.engine().parameters))


def test_paths_that_stay_leave_no_gap_and_are_traced_once(tmp_path, retraced):
    result = run(tmp_path)
    assert retraced[1] == [0.0]
    assert result.retrace_gap_db == pytest.approx(0, abs=1e-9)


def test_the_gap_is_that_of_the_paths(tmp_path, retraced):
    retraced[0][:] = [0.25]
    result = run(tmp_path)
    assert result.retrace_gap_db == pytest.approx(0.25, abs=1e-9)
    np.testing.assert_allclose(result.links["retrace_gap_db"], -0.25, atol=1e-9)


def test_auto_calibrates_again_on_the_new_paths_until_they_stay(tmp_path, retraced):
    retraced[0][:] = [0.8]  # changes once, then stays
    result = run(tmp_path)
    assert retraced[1] == [0.8, 0.8]
    assert result.retrace_gap_db == pytest.approx(0, abs=1e-9)


def test_rounds_bound_the_loop_and_zero_switches_it_off(tmp_path, retraced):
    retraced[0][:] = [0.8, 1.6, 2.4, 3.2, 4.0]
    result = run(tmp_path, fidelity={"rounds": 2})
    assert retraced[1] == [0.8, 1.6]
    assert result.retrace_gap_db > 0.5
    retraced[1].clear()
    assert run(tmp_path, fidelity={"rounds": 0}).retrace_gap_db is None
    assert retraced[1] == []


def test_a_method_with_a_budget_keeps_to_it(tmp_path, retraced):
    retraced[0][:] = [0.8]
    result = run(tmp_path, "sgwo-im")
    assert result.rt_calls == 225
    assert retraced[1] == [0.8]
    assert result.retrace_gap_db == pytest.approx(0.8, abs=1e-9)


def test_a_link_that_the_new_trace_loses_is_left_out_and_told(tmp_path, monkeypatch):
    paths = stronger(0.8)
    kept = take(paths, np.flatnonzero(paths.link != 3))
    monkeypatch.setattr(engines, "traced_paths", lambda *_: kept)
    result = run(tmp_path, offset={"bounds": [-5.0, 5.0]})
    assert not result.links["has_path"][3]
    assert result.links["has_path"].sum() == planted.LINKS - 1
    assert np.isfinite(result.rmse_db)
    assert np.isfinite(result.retrace_gap_db)
