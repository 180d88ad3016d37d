"""Constants of a cheap model, found by an input mapping (docs/measurements/expensive-engines.md).

    python benchmarks/cheap_model_constants.py --seeds 1000 1004 1009 1013 1018

An engine answers at points spread over the box and at four points near the optimum. The cheap model may have wrong
constants and lacks some of the features of the engine. It is corrected with the believed constants, with those that the
input mapping finds, and with the true ones. The columns are the negative log density of answers and constants, lower if
they are more probable, and the root mean square error of predictions near the optimum.
"""

# ruff: noqa: E402  (the number of threads has to be set before NumPy is imported)
from __future__ import annotations

import os

for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.arguments import Box
from calibray.optimizers.multifidelity.correction import UnitModel, correct, misfit, with_discrepancy
from calibray.optimizers.sampling import design
from calibray.paths import Kind, Paths
from cheap_model_errors import optimum, print_table
from problem_families.family import PlantedProblem, problem
from problem_families.problems import cheap_model

POINTS = (10, 20)
NEAR, JUDGED, APART = 4, 40, 0.2
"""Numbers of fitted and of predicted points near the optimum, and their largest distance from it in the unit cube."""

COLUMNS = (
    "problem", "parameters", "constants", "answers", "density: believed", "found", "true", "error [dB]: believed",
    "found", "true",
)  # fmt: skip


def true_constants(planted: PlantedProblem, model: UnitModel) -> NDArray[np.float64]:
    """The engine's values for the constants of the cheap model [q]."""
    parameters, count = cheap_model(planted).engine.parameters, len(planted.parameters)
    materials = planted.engine.paths.materials
    values = [getattr(materials[item.material], item.constant) for item in parameters][count:]
    searched = parameters.to_search(np.concatenate([parameters.start[:count], values]))[count:]
    gains = [0.0 if _found(planted, layer) else -np.inf for layer in planted.further]
    return np.clip([*searched, *gains], model.constants.lower, model.constants.upper)


def _found(planted: PlantedProblem, layer: Paths) -> bool:
    """Whether the engine finds the paths of a layer."""
    if (layer.kind == Kind.DIFFRACTION).any():
        return planted.differences.diffraction
    return bool(np.diff(layer.first).max() <= planted.differences.depth[0])


def rows(kind: str, seed: int) -> None:
    """Judge one problem and print its rows."""
    planted = problem(seed, kind)
    model = UnitModel(cheap_model(planted), Box.between(planted.lower, planted.upper))
    best, truth = model.box.to_unit(optimum(planted)[None])[0], true_constants(planted, model)
    for count in POINTS:
        random, d = np.random.default_rng(seed), len(best)
        points = np.clip(best + APART * random.uniform(-1.0, 1.0, (NEAR + JUDGED, d)), 0.0, 1.0)
        unit = np.vstack([design("sobol", count - NEAR, d, random), points[:NEAR]])
        residuals = planted.evaluate(model.box.from_unit(unit)).residuals
        judged = planted.evaluate(model.box.from_unit(points[NEAR:])).residuals
        cloud = design("sobol", 64, d, random)
        found = correct(model, (unit, residuals), cloud, random)
        believed, true = (
            with_discrepancy(model, constants, (unit, residuals), cloud)
            for constants in (model.constants.centre, truth)
        )
        three = (believed, found, true)
        density = [misfit(one, one.constants[None]).value[0] for one in three]
        error = [np.sqrt(np.mean((one.predict(points[NEAR:])[0] - judged) ** 2)) for one in three]
        cells = [f"{kind} {seed}", d, len(truth), count, *(f"{value:.0f}" for value in density)]
        print(f"| {' | '.join(map(str, cells + [f'{value:.3f}' for value in error]))} |", flush=True)


if __name__ == "__main__":
    print_table(str(__doc__), COLUMNS, rows, [1000, 1004, 1009, 1013, 1018])
