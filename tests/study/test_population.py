"""A population of directions: a common error, an estimated spread, an interval per transmitter and for new ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import calibray as cb
import two_ray
from calibray.cli.run import _trace
from calibray.engines.cluster.chunks import trace_in_chunks
from calibray.engines.cluster.workers import InProcess
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.study import Setup, Study
from calibray.study.mounting import with_spreads
from two_ray import COLUMNS, TwoRay

SECTORS, EACH, NOISE_DB = 8, 14, 2.0
GROUND = "ground.relative_permittivity"


def study(folder: Path, file: str, **parameters: object) -> Study:
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": two_ray.FREQUENCY},
        "links": {
            "file": file, "tx": COLUMNS[:3], "rx": COLUMNS[3:], "value": "path_loss_db",
            "tx_antenna": {"azimuth_deg": "azimuth"},
        },
        "antennas": {"tx": {"pattern": "tr38901"}, "rx": {"pattern": "dipole"}},
        "parameters": {GROUND: {"bounds": [1.5, 15.0]}} | parameters,
        "noise": {"kind": "gaussian", "range_m": 0},
    }  # fmt: skip
    return Study.from_content(content, folder / "study.toml")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sectors whose stated azimuths are off by 4 degrees in the mean, with a standard deviation of 5."""
    folder = tmp_path_factory.mktemp("population")
    two_ray.study(folder)
    random = np.random.default_rng(2)
    off = 4.0 + 5.0 * random.standard_normal(SECTORS)
    count = SECTORS * EACH
    sector = np.repeat(np.arange(SECTORS), EACH)
    tx = np.column_stack([50.0 * sector, np.zeros(count), np.full(count, 20.0)])
    bearing = np.radians(random.uniform(-70, 70, count) + 90.0)
    distance = random.uniform(30, 100, count)
    rx = tx + np.column_stack([distance * np.sin(bearing), distance * np.cos(bearing), np.full(count, -18.5)])
    table = pd.DataFrame(np.hstack([tx, rx]), columns=COLUMNS).assign(
        transmitter=[f"S{number}" for number in sector], azimuth=90.0, path_loss_db=100.0, off=off[sector]
    )
    table.to_csv(folder / "true.csv", index=False)
    loss = path_loss(Setup.open(study(folder, "true.csv"), tracer=TwoRay).trace())
    noisy = loss + NOISE_DB * random.standard_normal(count)
    stated = table.assign(azimuth=table["azimuth"] - off[sector], path_loss_db=noisy)
    stated.to_csv(folder / "stated.csv", index=False)
    return folder


def test_a_population_shrinks_to_its_mean_and_gives_new_transmitters_its_spread(folder: Path) -> None:
    bounds = {"bounds": [-40, 40]}
    population = study(folder, "stated.csv", **{"tx:*.azimuth": bounds | {"spread": "auto"}})
    result = cb.calibrate(population, tracer=TwoRay)
    table = pd.read_csv(folder / "stated.csv")
    off = table.groupby("transmitter")["off"].first()
    names = [f"tx:{label}.azimuth" for label in off.index]
    mean = result.parameters["tx:*.azimuth"]
    value = mean + np.array([result.parameters[name] for name in names])
    spread = result.study.parameters[names[0]].prior
    assert spread is not None
    assert spread.std == pytest.approx(off.std(), rel=0.5)
    assert mean == pytest.approx(off.mean(), abs=2.5)
    # The stated directions are worse than the estimates by more than half.
    assert np.sqrt(np.mean((value - off) ** 2)) < 0.5 * np.sqrt(np.mean(off**2))
    draws = {name: np.array(values) for name, values in result.uncertainty.draws.items()}
    held = [
        np.quantile(draws["tx:*.azimuth"] + draws[name], 0.05)
        <= true
        <= np.quantile(draws["tx:*.azimuth"] + draws[name], 0.95)
        for name, true in zip(names, off, strict=True)
    ]
    assert np.mean(held) >= 0.7
    # No link narrows the value of a new transmitter: its interval is the population's.
    assert np.std(draws["tx:new transmitters.azimuth"]) == pytest.approx(spread.std, rel=0.35)
    known, new = table.iloc[:EACH], table.iloc[:EACH].assign(transmitter="S99")
    width = [
        (interval["upper_db"] - interval["lower_db"]).to_numpy()
        for interval in (result.predict_interval(rows) for rows in (known, new))
    ]
    assert (width[1] >= width[0] - 0.3).all()
    assert (width[1] - width[0]).max() > 0.2


def test_a_validation_estimates_the_spread_as_a_calibration_does(folder: Path) -> None:
    population = study(folder, "stated.csv", **{"tx:*.azimuth": {"bounds": [-40, 40], "spread": "auto"}})
    rmse_db = cb.validate(population, tracer=TwoRay).table["rmse_db"]
    # With the wide spread at which the estimate starts, errors of held-out links are half again as large.
    assert rmse_db["calibrated"] < 1.1 * rmse_db["initial materials"]


def test_a_stated_spread_is_kept_and_own_parameters_stay(folder: Path) -> None:
    stated = study(
        folder,
        "stated.csv",
        **{
            "tx:*.azimuth": {"bounds": [-40, 40], "spread": 3.0},
            "tx:S1.azimuth": {"bounds": [-9, 9], "start": 1.0},
        },
    )
    parameters = Setup.open(stated, tracer=TwoRay).study.parameters
    assert parameters["tx:S1.azimuth"].prior is None
    assert parameters["tx:S2.azimuth"].prior.std == 3.0
    assert len(parameters) == 2 + SECTORS + 1
    changed = with_spreads(Setup.open(stated, tracer=TwoRay).study, {"azimuth": 5.0})["parameters"]
    assert "prior" not in changed["tx:S1.azimuth"]
    assert changed["tx:S2.azimuth"]["prior"]["std"] == 5.0
    again = Setup.open(Study.from_content(Setup.open(stated, TwoRay).study.content(), stated.path), TwoRay)
    assert again.study.content() == Setup.open(stated, TwoRay).study.content()


def test_traces_and_their_check_have_the_stated_antennas(folder: Path) -> None:
    setup = Setup.open(study(folder, "stated.csv"), tracer=TwoRay)
    calibrated = path_loss(setup.trace())
    alone = _trace(setup, None, overwrite=False, trace_again=True, progress=lambda *_: None)
    chunked = trace_in_chunks(setup, InProcess(), check=True)
    for paths, change in (alone, chunked):
        assert path_loss(paths) == pytest.approx(calibrated)
        assert change is not None
        # This tracer always finds the same paths.
        assert change.converged(1e-6)


def test_only_all_transmitters_have_a_spread(folder: Path) -> None:
    with pytest.raises(
        InputError, match=r"tx:S1.azimuth: spread describes a population of transmitters; state it for"
    ):
        study(folder, "stated.csv", **{"tx:S1.azimuth": {"bounds": [-9, 9], "spread": "auto"}})
