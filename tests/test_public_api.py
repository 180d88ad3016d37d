"""The public surface, frozen: a change here is a breaking change and belongs into the changelog."""

import ast
import inspect
from pathlib import Path

import pytest

import calibray as cb

SIGNATURES = {
    "Material": "relative_permittivity, conductivity, thickness, scattering_coefficient, xpd_coefficient, "
    "scattering_pattern, alpha_r, alpha_i, lambda_",
    "itu_material": "name, frequency, thickness, revision, scattering",
    "read_measurements": "path, tx, rx, value, quantity, where, group, weight, std, tx_power_dbm, frequency",
    "trace": "scene, measurements, frequency, tx_antenna, rx_antenna, materials, progress, settings",
    "path_gains": "paths, materials",
    "path_loss": "paths, materials, combining, bandwidth",
    "calibrate": "study, method, seed, out, engine, workers, progress, tracer, overwrite, cheap_model",
    "report": "result, file, figures, overwrite, progress",
    "coverage_map": "result, tx, height, cell, bounds, level, power_dbm, samples, columns, progress, workers, "
    "allow_changed_inputs",
    "save_map": "coverage, folder, inputs, overwrite",
    "validate": "study, blocks, by, workers, progress, tracer",
    "suggest": "result, candidates, count, progress, allow_changed_inputs",
    "channel_statistics": "paths, materials",
    "power_delay_profile": "paths, delays, materials",
}
NAMES = {*SIGNATURES, "Measurements", "Paths", "Result", "Setup", "Study", "engines", "optimizers"}


def test_names_are_frozen():
    assert set(cb.__all__) == NAMES
    assert {name for name in NAMES if not hasattr(cb, name)} == set()


def test_type_checkers_see_every_name():
    module = ast.parse(Path(cb.__file__).read_text(encoding="utf-8"))
    guarded = next(each for each in module.body if isinstance(each, ast.If))
    seen = {alias.asname for each in guarded.body if isinstance(each, ast.ImportFrom) for alias in each.names}
    assert seen == NAMES


@pytest.mark.parametrize("name", SIGNATURES)
def test_signatures_are_frozen(name):
    assert ", ".join(inspect.signature(getattr(cb, name)).parameters) == SIGNATURES[name]


def test_parts_of_the_design_are_there():
    assert callable(cb.engines.make)
    assert {"GWO", "SGWOIM"} <= set(dir(cb.optimizers))
    assert callable(cb.Paths.load)
    assert callable(cb.Paths.save)
    assert callable(cb.Study.load)
    assert callable(cb.Result.predict)
    assert {"rmse_db", "initial_rmse_db", "holdout_rmse_db", "rt_calls", "materials", "parameters"} <= set(
        dir(cb.Result)
    )
    assert {"fit", "accuracy", "uncertainty", "nuisance", "prediction", "cost", "provenance"} <= set(
        cb.Result.__dataclass_fields__
    )
    assert all(callable(getattr(cb.Result, verb)) for verb in ("report", "export", "coverage_map", "suggest"))


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="no attribute 'tracer'"):
        cb.tracer  # noqa: B018
