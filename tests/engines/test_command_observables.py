"""Further observables from an external program: files, ledger, and a calibration on both."""

from __future__ import annotations

import json
from contextlib import closing

import h5py
import numpy as np
import pytest

import planted
import programs
from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.engines.external.exchange import Unusable, read_answer
from calibray.errors import EngineError, InputError
from calibray.study import Study

SPREAD = """
spread = [20 + 2 * values[2] * (1 + math.sin(rx[1])) for rx in request["links"]["rx"]]
spread[3] = None
"""
ANSWER = """
import shutil; shutil.copy(request_file, "kept.json")
with open(response_file, "w") as file:
    json.dump({"path_loss_db": losses, "observables": [spread]}, file)
"""
SECTION = {"kind": "rms_delay_spread", "column": "spread_ns", "unit": "ns", "std": 0.5, "bandwidth": 1e8}


def expected(candidates: np.ndarray) -> np.ndarray:
    """What the program answers [n, L], [ns]."""
    rx_y = planted.links()["rx_y"].to_numpy()
    spread = 20 + 2 * np.atleast_2d(candidates)[:, 2:] * (1 + np.sin(rx_y))
    spread[:, 3] = np.nan
    return spread


def study(folder, after=ANSWER, **sections):
    content = programs.content(folder, SPREAD, after)
    table = planted.links().assign(
        path_loss_db=programs.expected(programs.TRUTH, planted.links())[0],
        spread_ns=expected(programs.TRUTH)[0],
    )
    table.to_csv(folder / "links.csv", index=False)
    content |= {
        "observables": {"spread": SECTION},
        "noise": {"kind": "gaussian", "range_m": 0, "std_db": 1.0},
    }
    return Study.from_content(content | sections, folder / "study.toml")


def test_one_call_answers_for_path_loss_and_observables(tmp_path):
    plan = study(tmp_path)
    wanted = (plan.observables["spread"].statistic,)
    candidates = np.array([[3.0, 4.0, 5.0], [2.0, 9.0, 1.5]])
    engine = engines.make(plan, ledger=tmp_path / "ledger.sqlite")
    answer = engine.respond(candidates, wanted)
    assert answer.path_loss == pytest.approx(programs.expected(candidates, planted.links()))
    assert answer.observed[:, 0] == pytest.approx(1e-9 * expected(candidates), nan_ok=True)
    (asked,) = json.loads((tmp_path / "kept.json").read_text())["observables"]
    assert asked == {
        "name": "spread", "unit": "ns", "kind": "rms_delay_spread", "path": "mean", "bandwidth": 1e8
    }  # fmt: skip
    # The ledger keeps both.
    again = engines.make(study(tmp_path), ledger=tmp_path / "ledger.sqlite")
    repeated = again.respond(candidates, wanted)
    np.testing.assert_array_equal(repeated.observed, answer.observed)
    assert (again.calls, again.hits, len(programs.calls(tmp_path))) == (0, 2, 2)
    with pytest.raises(InputError, match="no derivatives"):
        again.respond(candidates, wanted, derivatives=True)
    with closing(engines.Ledger(tmp_path / "ledger.sqlite")) as ledger:
        assert len(ledger.table()) == 2


@pytest.mark.parametrize(
    ("observables", "message"),
    [
        ("", "no key 'observables'"),
        (', "observables": [[1, 2], [3, 4]]', r"shape \(2, 2\); it must be \(1, 2\)"),
        (', "observables": [[1, 2], [3]]', "lists of different lengths"),
        (', "observables": [[1, "many"]]', 'contains "many" in observables'),
    ],
)
def test_answers_without_usable_observables_are_refused(tmp_path, observables, message):
    file = tmp_path / "response.json"
    file.write_text(f'{{"path_loss_db": [70, 80]{observables}}}')
    with pytest.raises(Unusable, match=message):
        read_answer(file, "json", 2, 1)


def test_two_observables_of_one_link_may_be_a_list_of_numbers(tmp_path):
    """As MATLAB writes a column."""
    file = tmp_path / "response.json"
    file.write_text('{"path_loss_db": 70, "observables": [1, 2]}')
    _, observed = read_answer(file, "json", 1, 2)
    assert observed.tolist() == [[1.0], [2.0]]
    file.write_text('{"path_loss_db": 70, "observables": []}')
    with pytest.raises(Unusable, match=r"shape \(0,\); it must be \(2, 1\)"):
        read_answer(file, "json", 1, 2)


def test_observables_in_hdf5(tmp_path):
    file = tmp_path / "response.h5"
    with h5py.File(file, "w") as response:
        response["path_loss_db"], response["observables"] = [70.0, 80.0], [[1.0, np.nan], [3.0, 4.0]]
    _, observed = read_answer(file, "hdf5", 2, 2)
    np.testing.assert_array_equal(observed, [[1.0, np.nan], [3.0, 4.0]])
    with pytest.raises(Unusable, match="must contain 6 numbers"):
        read_answer(file, "hdf5", 2, 3)


@pytest.mark.parametrize(
    ("name", "budget", "bias"), [("vector-surrogate", 30, {}), ("auto", 12, {"bias": "all"})]
)
def test_a_program_is_calibrated_on_both(tmp_path, name, budget, bias):
    """`wood` moves path loss little and delay spreads much; `auto` is space mapping with the replay of the scene."""
    sections = {"observables": {"spread": SECTION | bias}}
    result = calibrate(study(tmp_path, method={"name": name, "options": {"budget": budget}}, **sections))
    # After the search, the program answers for the start and the calibrated values only, whatever the biases.
    assert len(set(programs.calls(tmp_path))) <= result.rt_calls + 1 <= budget + 1
    assert result.parameters["wood.relative_permittivity"] == pytest.approx(programs.TRUTH[2], abs=0.3)
    fit = result.fit.observables["spread"]
    assert fit.links == planted.LINKS - 1
    assert fit.rmse < 0.5 < fit.initial_rmse
    assert len(fit.bias_errors) == len(bias)
    assert all(0.05 < error < 2 for error in fit.bias_errors.values())
    interval = result.intervals["wood.relative_permittivity"]
    assert interval.upper - interval.lower < 2.0


def test_a_program_that_answers_no_observables_is_at_fault(tmp_path):
    with pytest.raises(EngineError, match="no key 'observables'"):
        calibrate(study(tmp_path, after=programs.ANSWER))


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"observables": {"spread": {**SECTION, "std": None}}}, r"observables.spread.std: is required"),
        ({"noise": {"kind": "gaussian"}}, r"noise.std_db: is required"),
        ({"engine": {"name": "retrace"}}, "use 'replay' or 'command'"),
        ({"engine": {"name": "replay", "compress_db": 0.1}}, "few weighted paths preserves path loss"),
    ],
)
def test_what_observables_need_of_an_engine(tmp_path, sections, message):
    sections = {
        key: {name: {k: v for k, v in each.items() if v is not None} for name, each in value.items()}
        if key == "observables"
        else value
        for key, value in sections.items()
    }
    with pytest.raises(InputError, match=message):
        study(tmp_path, **sections)
