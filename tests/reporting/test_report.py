"""Tables of results, traces, the demo, comparisons and diagnoses."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd

import shown
from calibray.calibration.result import Result
from calibray.comparison import comparison
from calibray.reporting import result_tables
from calibray.reporting import scene_tables as trace
from calibray.reporting.figures import cumulative_cost
from calibray.reporting.page import _laws, _tiles
from calibray.reporting.summary import summary
from calibray.reporting.wording import (
    _neighbours_text,
    carriers_text,
    diagnostics_table,
    method_text,
    prediction_text,
    scene_alone_text,
)
from calibray.result.held_out import Model, ResidualField
from calibray.result.verdict import Interval, Verdict
from calibray.study import Study
from calibray.tables import render
from calibray.tracing.protocol import EnclosedAntennas
from changed import changed
from markdown_tables import render_markdown


def golden(name: str) -> str:
    """The stored text of a record of `shown`."""
    return (shown.GOLDEN / f"{name}.txt").read_text(encoding="utf-8").removesuffix("\n")


def inside(of: str) -> EnclosedAntennas:
    """Antennas inside buildings for the twelve links of the stored result: one or most."""
    row, link, none = shown.result().links["row"].to_numpy(), np.arange(12), np.zeros(12, dtype=bool)
    return EnclosedAntennas.of(row, none, link == 5 if of == "one" else link < 11)


def test_a_result_is_printed_as_stored():
    for name, found, enclosed in (
        ("result", shown.result(), inside("one")),
        ("result-bare", shown.bare_result(), inside("most")),
    ):
        text = render(result_tables.heading(found), *result_tables.tables(changed(found, enclosed=enclosed)))
        assert text == golden(name)


def test_a_law_of_one_constant_and_several_carriers_are_reported():
    result = changed(shown.result(), laws={"walls": {"itu_a": 5.1, "itu_b": 0.1}})
    (law,) = _laws(result).rows
    assert law == ("walls", "5.1", "0.1", "-", "-")
    carriers = np.where(np.arange(len(result.links)) % 2, 28e9, 3.5e9)
    several = replace(result, links=result.links.assign(frequency=carriers))
    assert carriers_text(result) == "3.5 GHz"
    assert carriers_text(several) == "3.5 GHz, 28 GHz"
    scope = summary(several)[1].text
    assert "at 3.5 GHz, 28 GHz, on" in scope


def test_the_result_of_an_external_program_names_its_method_its_failures_and_its_predictions():
    content = shown.result().study.content()
    content |= {"engine": {"name": "command", "command": ["model"]}, "method": {"name": "auto"}}
    result = changed(shown.result(), study=Study.from_content(content, "external.toml"), cheap_replays=10)
    history = result.history.assign(rmse_db=result.history.rmse_db.where(result.history.index > 1, np.inf))
    assert "by auto (space mapping) with the engine command" in summary(result)[1].text
    assert method_text(changed(result, cheap_replays=0), "auto") == "auto (vector surrogate)"
    assert method_text(shown.result(), "auto") == "auto (least squares)"
    assert ("failed, or a link lost its path", "2") in result_tables.costs(
        replace(result, history=history)
    ).rows
    assert "Predictions and maps call the program" in scene_alone_text(result)
    # `calibray suggest` refuses such a result.
    name = next(iter(result.parameters))
    ambiguous = {"draws": {name: [2.0, 8.0]}, "intervals": {name: Interval(1.0, 2.0, 8.0, Verdict.AMBIGUOUS)}}
    advised = [changed(each, **ambiguous) for each in (shown.result(), result)]
    assert ["calibray suggest" in str(summary(each)) for each in advised] == [True, False]
    assert "differs from the predictions" in scene_alone_text(shown.result())


def predicted_by(name: str, **values: object) -> Result:
    """The stored result with another prediction model."""
    result = shown.result()
    model = replace(result.prediction.model, name=name, **values)
    return replace(result, prediction=replace(result.prediction, model=model))


def test_an_average_without_nuisances_is_a_whole_sentence():
    values = dict(shown.result().parameters)
    near = {name: 1.01 * value for name, value in values.items()}
    model = {"averaged": values, "parameters": near}
    average = predicted_by(Model.AVERAGE_CALIBRATED, **model)
    text = "with materials calibrated with a prior, averaged with the calibrated materials"
    assert prediction_text(average).startswith(
        f"Predictions and maps use the model '{Model.AVERAGE_CALIBRATED}', {text}, and the fitted offset."
    )
    assert f"{text}." in prediction_text(predicted_by(Model.AVERAGE_CALIBRATED, **model, terms=()))


def test_the_model_with_obstruction_uses_the_scene_but_no_materials():
    assert "which uses no scene" in scene_alone_text(predicted_by(Model.LOG_DISTANCE, parameters=None))
    obstruction = scene_alone_text(predicted_by(Model.OBSTRUCTION, parameters=None))
    assert "which uses no materials" in obstruction
    # An offset is no difference between the scene and the model.
    assert "dB after subtracting the mean" in obstruction or "dB after subtracting their mean" in obstruction


def test_the_mean_of_each_group_is_mentioned_only_with_groups():
    result = shown.result()
    grouped = replace(result, links=result.links.assign(group=["east", "west"] * 6))
    alone = replace(result, links=result.links.drop(columns="group", errors="ignore"))
    assert "dB after subtracting the mean of each group)" in scene_alone_text(grouped)
    assert "dB after subtracting their mean)" in scene_alone_text(alone)
    single = replace(alone, links=alone.links.iloc[:1].assign(scene_db=80.0, predicted_db=90.0))
    assert "by 10.00 dB (RMS over 1 link; 0.00 dB after subtracting their mean)" in scene_alone_text(single)


def test_one_interaction_is_singular():
    result = shown.result()
    depth = np.where(np.arange(12) < 6, 1.0, 2.0)
    shift = np.where(depth == 1, 9.0, -1.0) + result.links.measured_db
    deep = replace(
        result, links=result.links.assign(depth=depth, predicted_db=shift, has_path=True, held_out=False)
    )
    assert ", paths of 1 interaction, 6 links" in dict(diagnostics_table(deep).rows)["by depth"]


def test_the_rival_with_further_nuisances_is_not_called_an_offset_alone():
    result = shown.result()
    slope = changed(result, coefficients={**result.nuisance.coefficients, "slope": {"": 1.0}})
    headings = [result_tables.nuisances(found).headings for found in (result, slope)]
    assert headings == [("Offsets", "[dB]"), ("Nuisances", "[dB per unit]")]
    names = [[text.partition(":")[0] for text in _tiles(found)[0][2]] for found in (result, slope)]
    assert [found[1] for found in names] == [
        "initial materials, offset only",
        "initial materials, nuisances only",
    ]


def test_antennas_below_the_ground_have_their_own_line():
    """If they are most antennas, the scene is still no indoor scene."""
    below = shown.ROWS > 2
    enclosed = EnclosedAntennas.of(shown.ROWS, below, ~below, below)
    text = render(trace.overview(shown.paths(), shown.ROWS, enclosed))
    assert re.search(
        r"transmitter inside a building +0\ntransmitter below the ground +29 +rows 3, .*heights", text
    )
    assert re.search(r"receiver inside a building +1 +row 2: check the positions", text)


def test_a_trace_and_its_check_are_printed_as_stored():
    enclosed = EnclosedAntennas.of(shown.ROWS, shown.ROWS < 4, shown.ROWS == 9)
    assert render(trace.overview(shown.paths(), shown.ROWS, enclosed)) == golden("trace")
    assert render(*trace.convergence(shown.convergence(), shown.ROWS, 0.5)) == golden("convergence")


def test_demo_comparison_and_diagnosis_are_printed_as_stored():
    assert render(*shown.demo().tables()) == golden("demo")
    assert render(comparison.table(shown.comparison())) == golden("comparison")
    assert render_markdown(comparison.table(shown.comparison())) == golden("comparison-markdown")
    assert render(shown.diagnosis().table()) == golden("doctor")


def test_tables_and_figures_import_no_ray_tracer():
    code = """
import importlib, sys
for name in ("calibray.doctor", "calibray.comparison.comparison"):
    importlib.import_module(name)
for name in "figures result_tables scene_tables".split():
    importlib.import_module(f"calibray.reporting.{name}")
heavy = ("jax", "drjit", "mitsuba", "sionna")
print([name for name in heavy if name in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.stdout, run.stderr) == ("[]\n", "")


def test_the_line_of_the_surrogate_is_after_the_last_full_iteration():
    """With one iteration there is none; with one full iteration it is after the first."""

    def lines(calls: list[int]) -> list[float]:
        iteration = np.repeat(np.arange(1, len(calls) + 1), calls)
        number = np.arange(1, len(iteration) + 1)
        history = pd.DataFrame({"iteration": iteration, "call": number, "seconds": 0.1 * number})
        panels = cumulative_cost({"sgwo-im": replace(shown.result(), history=history)}).axes
        return [line.get_xdata()[0] for line in panels[0].lines if line.get_linestyle() == "--"]

    assert lines([30, 30, 5, 5]) == [2]
    assert lines([30, 5, 5]) == [1]
    assert lines([30]) == []


def test_times_are_written_without_an_exponent():
    for seconds, text in ((0.034, "0.034 s"), (98.4, "98 s"), (99.7, "2 min"), (1500.0, "25 min")):
        assert f"RT calls in {text}, after" in summary(changed(shown.result(), seconds=seconds))[1].text


def test_sentences_about_correlated_errors_agree():
    """The nearest pairs alone show no correlation, but the fitted model, which predictions use, has one."""
    field, table = ResidualField(range_m=20.0, shared_db=1.0, own_db=1.0), pd.DataFrame({
        "distance_m": [10.0, 20.0, 30.0, 40.0], "semivariance_db2": [2.0] * 4, "pairs": [9] * 4,
    })  # fmt: skip
    assert _neighbours_text(table, None) == "the errors of links 10 m apart show no significant correlation"
    assert _neighbours_text(table, field) == "links 10 m apart share 30 % of the variance of their errors"
    result = shown.result()
    near = replace(result, prediction=replace(result.prediction, residual_field=field))
    assert "(standard deviation in the fitted model: 1.00 dB)" in scene_alone_text(near)
