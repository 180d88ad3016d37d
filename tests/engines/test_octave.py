"""The example in MATLAB/Octave: a program that Calibray knows nothing of, against the ray tracer."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.errors import EngineError
from calibray.fitting.problem import Problem
from calibray.fitting.search import rounds
from calibray.measurements import read_measurements
from calibray.optimizers import LeastSquares
from calibray.study import Study

EXAMPLE = Path(__file__).parents[2] / "examples" / "octave_canyon"
TRUTH = np.array([[6.4, 15.0]])
FEW_RAYS = {"samples": 20_000}  # find every path of the street
EXACT = {"kind": "gaussian", "range_m": 0, "heterogeneity": 0, "constants_spread": 0}
pytestmark = pytest.mark.skipif(shutil.which("octave-cli") is None, reason="GNU Octave is not installed")


def example(**sections) -> Study:
    """The example's study; sections given replace its own."""
    study = Study.load(EXAMPLE / "study.toml")
    return Study.from_content(
        study.content() | {"trace": {"max_depth": 1, **FEW_RAYS}} | sections, study.path
    )


@pytest.mark.parametrize("combining", ["power", "coherent"])
def test_the_program_agrees_with_the_ray_tracer(combining):
    study = example(objective={"combining": combining})
    candidates = np.vstack([TRUTH, [[1.8, 27.0]]])
    program = engines.make(study).path_loss(candidates)
    assert program == pytest.approx(engines.make(study, "replay").path_loss(candidates), abs=1e-3)
    assert np.abs(program[0] - program[1]).max() > 1.0


def test_the_links_are_simulated_with_the_values_that_the_readme_names():
    study = example()
    error = engines.make(study).path_loss(TRUTH)[0] - study.measurements().path_loss_db
    assert 0.3 < np.sqrt(np.mean(error**2)) < 0.7


def test_a_calibration_on_the_program_ends(tmp_path):
    study = example(method={"name": "random", "options": {"budget": 6}}, noise=EXACT)
    with engines.open_workers(2) as workers:
        result = calibrate(study, out=tmp_path, workers=workers)
    assert result.rt_calls == 6
    assert result.rmse_db < result.initial_rmse_db


def test_a_simpler_program_is_calibrated_by_space_mapping_in_six_calls():
    """The optimum is that of the replay with one reflection and surfaces of one face, which is the program's model."""
    study = Study.load(EXAMPLE / "simple.toml")
    content = study.content()
    content |= {"method": content["method"] | {"options": {"budget": 6}}, "noise": EXACT}
    mapped = calibrate(Study.from_content(content | {"trace": {"max_depth": 2, **FEW_RAYS}}, study.path))
    assert mapped.rt_calls == 6
    same = {
        "materials": {name: {"thickness": 100.0} for name in ("walls", "ground")},
        "trace": {"max_depth": 1, **FEW_RAYS},
        "engine": {"name": "replay"},
        "method": {"name": "random", "options": {"budget": 1}},
    }
    setup = Study.from_content(content | same, study.path).opened()
    half_space = Problem.of(setup, engines.make(setup))
    search = LeastSquares(*half_space.parameters.search_bounds, starts=8)
    for _ in rounds(search, half_space.evaluate):
        pass
    assert search.best.y == pytest.approx(0.4678, abs=1e-3)
    assert mapped.rmse_db - search.best.y < 0.01 < mapped.history.best_db[0] - search.best.y


def test_a_request_that_the_program_cannot_serve_is_refused_in_its_own_words():
    study = example(
        antennas={"tx": {"pattern": "dipole"}}, engine=example().content()["engine"] | {"retries": 0}
    )
    with pytest.raises(EngineError, match="only isotropic antennas are programmed"):
        engines.make(study).path_loss(TRUTH)


RAYS = """
ray = @(tx, rx, loss, sight) struct('CoordinateSystem', 'Cartesian', 'TransmitterLocation', tx, ...
    'ReceiverLocation', rx, 'PathLoss', loss, 'PhaseShift', 0.5, 'PropagationDelay', 1e-7, 'Frequency', 3.5e9, ...
    'AngleOfDeparture', [10; -5], 'AngleOfArrival', [190; 5], 'LineOfSight', sight, 'NumInteractions', 2);
tx = [0; 0; 10];
near = [ray(tx, [30; 4; 1.5], 80, true); ray(tx, [30; 4; 1.5], 83, false)];
rays = {near, [], ray(tx, [60; -4; 1.5], 95.25, false)};
rays_to_links(rays, '%s');
"""


def test_rays_of_matlab_become_links(tmp_path):
    """Two rays add their powers, a pair without a ray is no link, and the tables say where all of it lies."""
    command = ["octave-cli", "--quiet", "--path", str(EXAMPLE.parent / "matlab"), "--eval", RAYS % tmp_path]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    links = read_measurements(
        tmp_path / "links.csv",
        [f"tx_{axis}" for axis in "xyz"],
        [f"rx_{axis}" for axis in "xyz"],
        "path_loss_db",
    )
    together = -10 * np.log10(10**-8.0 + 10**-8.3)
    assert links.path_loss_db == pytest.approx([together, 95.25])
    assert links.rx.tolist() == [[30, 4, 1.5], [60, -4, 1.5]]
    paths = pd.read_csv(tmp_path / "paths.csv")
    assert paths.interactions.tolist() == [0, 2, 2]
    assert paths.receiver.tolist() == [1, 1, 3]
