"""The public names and signatures are frozen: a change here is a breaking change and belongs in the changelog."""

import ast
import inspect
from importlib.metadata import version
from pathlib import Path

import pytest

import calibray as cb

SIGNATURES = {
    "Material": "relative_permittivity, conductivity, thickness, scattering_coefficient, xpd_coefficient, "
    "scattering_pattern, alpha_r, alpha_i, lambda_",
    "itu_material": "name, frequency, thickness, revision, scattering",
    "read_measurements": "path, tx, rx, value, quantity, where, group, weight, std, tx_power_dbm, frequency",
    "trace": "scene, measurements, frequency, tx_antenna, rx_antenna, materials, progress, settings",
    "read_rays": "rays, scene, frequency, antennas, axes, tx_power_dbm",
    "write_rays": "paths, file, overwrite",
    "path_gains": "paths, materials",
    "path_loss": "paths, materials, combining, bandwidth",
    "calibrate": "study, method, seed, out, engine, workers, progress, tracer, overwrite, cheap_model",
    "report": "result, file, figures, overwrite, progress",
    "coverage_map": "result, tx, height, cell, bounds, level, power_dbm, samples, columns, progress, workers, "
    "allow_changed_inputs",
    "validate": "study, blocks, by, workers, progress, tracer, ledger",
    "suggest": "result, candidates, count, progress, allow_changed_inputs, observables",
    "channel_statistics": "paths, materials",
    "power_delay_profile": "paths, delays, materials",
}
NAMES = {
    *SIGNATURES,
    "EngineError",
    "InputError",
    "Measurements",
    "Paths",
    "Result",
    "Setup",
    "Study",
    "__version__",
    "engines",
    "optimizers",
}

RESULT_METHODS = {
    "load": "folder, allow_changed_inputs",
    "save": "self, folder, overwrite",
    "predict": "self, links, progress, allow_changed_inputs",
    "predict_interval": "self, links, level, progress, allow_changed_inputs",
    "coverage_map": "self, tx, height, cell, bounds, level, power_dbm, samples, columns, progress, workers, "
    "allow_changed_inputs",
    "suggest": "self, candidates, count, progress, allow_changed_inputs, observables",
    "report": "self, file, overwrite, progress",
    "apply": "self, scene",
    "export": "self, folder, copy, overwrite, allow_changed_inputs",
}


def test_names_are_frozen():
    assert set(cb.__all__) == NAMES
    assert {name for name in NAMES if not hasattr(cb, name)} == set()


def test_type_checkers_see_every_name():
    module = ast.parse(Path(cb.__file__).read_text(encoding="utf-8"))
    guarded = next(statement for statement in module.body if isinstance(statement, ast.If))
    imports = [statement for statement in guarded.body if isinstance(statement, ast.ImportFrom)]
    assert {alias.asname for statement in imports for alias in statement.names} == NAMES - {"__version__"}


def test_the_version_is_that_of_the_package():
    assert cb.__version__ == version("calibray")
    assert "__version__" in dir(cb)


@pytest.mark.parametrize("name", SIGNATURES)
def test_signatures_are_frozen(name):
    assert ", ".join(inspect.signature(getattr(cb, name)).parameters) == SIGNATURES[name]


@pytest.mark.parametrize("name", RESULT_METHODS)
def test_the_methods_of_a_result_are_frozen(name):
    assert ", ".join(inspect.signature(getattr(cb.Result, name)).parameters) == RESULT_METHODS[name]


def test_a_coverage_map_saves_itself():
    coverage = inspect.signature(cb.coverage_map, eval_str=True).return_annotation
    assert ", ".join(inspect.signature(coverage.save).parameters) == "self, folder, inputs, overwrite"


def test_the_names_of_the_design_exist():
    assert callable(cb.engines.make)
    assert {"GWO", "SGWOIM"} <= set(dir(cb.optimizers))
    assert callable(cb.Paths.load)
    assert callable(cb.Paths.save)
    assert callable(cb.Study.load)
    assert callable(cb.Setup.open)
    assert {"rmse_db", "initial_rmse_db", "holdout_rmse_db", "rt_calls", "materials", "parameters"} <= set(
        dir(cb.Result)
    )
    assert {"fit", "accuracy", "uncertainty", "nuisance", "prediction", "cost", "provenance"} <= set(
        cb.Result.__dataclass_fields__
    )


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="no attribute 'tracer'"):
        cb.tracer  # noqa: B018
