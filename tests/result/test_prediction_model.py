"""One record decides what predictions, exports and the report use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sionna.rt as rt

import planted
import shown
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.reporting.export import export
from calibray.reporting.link_survey import residual
from calibray.reporting.result_tables import parameters, values
from calibray.reporting.summary import summary
from calibray.reporting.wording import prediction_text, scene_alone_text
from calibray.result.held_out import FittedTerm, Model, ResidualField
from calibray.result.verdict import Interval, ReasonKind, Verdict
from calibray.result.wording import reason_text
from calibray.scenes import read_scene
from calibray.scenes.scene import exported_names
from calibray.tables import render
from calibray.uncertainty.verdicts import consistent
from calibray.validation import held_out_statistics
from calibray.validation.choice import averaged_terms

NAME = next(name for name in shown.result().parameters if name.endswith(".relative_permittivity"))
MATERIAL = NAME.rpartition(".")[0]


@pytest.fixture
def other() -> Result:
    """A result whose prediction model has another ground than the calibrated one, and an offset of +3 dB."""
    result = shown.result()
    model = result.prediction.model
    parameters = {**model.parameters, NAME: 7.25}
    material = replace(result.materials[MATERIAL], relative_permittivity=7.25)
    links = result.links.assign(predicted_db=result.links.scene_db + 3.0)
    term = replace(model.terms[0], per="", coefficients={"": 3.0})
    prediction = replace(
        result.prediction,
        model=replace(model, name=Model.PRIOR, parameters=parameters, terms=(term,)),
        materials={**result.materials, MATERIAL: material},
    )
    return replace(result, prediction=prediction, links=links)


def test_the_tables_say_which_values_predictions_use(other: Result) -> None:
    assert "in predictions" not in render(parameters(shown.result()))
    text = render(parameters(other))
    assert "in predictions" in text
    assert "7.25" in text
    assert {value.name: value.predicted for value in values(other)}[NAME] == "7.25"
    assert summary(other)[0].text.startswith("Predictions and maps use the model 'calibrated with prior'")


def test_the_residuals_of_the_report_are_those_of_predictions(other: Result) -> None:
    expected = other.links.predicted_db - other.links.measured_db
    np.testing.assert_array_equal(residual(other.links, sign=1)[:5], expected[:5])


def test_the_exported_scene_is_the_one_that_predictions_use(tmp_path: Path) -> None:
    table = planted.campaign(noise_db=0.5)
    result = calibrate(planted.study(tmp_path, table), engine=planted.engine())
    model = result.prediction.model
    name, value = next(iter(model.parameters.items()))
    material, _, constant = name.rpartition(".")
    materials = {
        **result.materials,
        material: replace(result.materials[material], **{constant: value * 1.25}),
    }
    model = replace(model, name=Model.PRIOR, parameters={**model.parameters, name: value * 1.25})
    changed = replace(result, prediction=replace(result.prediction, model=model, materials=materials))
    export(changed, tmp_path / "exported")
    changed.save(tmp_path / "out")
    exported = exported_names(result.materials)[material]
    for file in (tmp_path / "exported" / "scene.xml", tmp_path / "out" / "result-scene.xml"):
        written = read_scene(file, result.study.scene.frequency).materials[exported]
        assert getattr(written, constant) == pytest.approx(value * 1.25, rel=1e-6)
    scene = rt.load_scene(rt.scene.simple_street_canyon)
    changed.apply(scene)
    live = np.array(getattr(scene.radio_materials[material], constant)).item()
    assert live == pytest.approx(value * 1.25, rel=1e-6)
    loaded = Result.load(tmp_path / "out")
    links = planted.links()
    assert np.abs(loaded.predict(links) - result.predict(links)).max() > 0.01


def test_an_offset_is_named_as_the_difference_between_scene_and_predictions(other: Result) -> None:
    assert "differs from the predictions by 3.00 dB" in scene_alone_text(other)
    assert "0.00 dB after subtracting their mean" in scene_alone_text(other)
    assert "cannot contain the offset." in scene_alone_text(other)
    same = replace(other, links=other.links.assign(predicted_db=other.links.scene_db))
    assert scene_alone_text(same) == ""
    field = replace(same.prediction, residual_field=ResidualField(range_m=12.0, shared_db=2.5, own_db=1.0))
    near = scene_alone_text(replace(same, prediction=field))
    assert "Within about 12 m of measured links" in near
    assert "(standard deviation in the fitted model: 2.50 dB)" in near
    assert scene_alone_text(replace(other, prediction=field)).endswith(near)
    assert "calibrated" in prediction_text(shown.result())


def test_a_filter_of_held_out_links_chooses_the_model_too(tmp_path: Path) -> None:
    """Path loss planted by distance alone: predictions follow the distance law, as after held-out blocks."""
    links = planted.links()
    distance = np.linalg.norm(links[["rx_x", "rx_y"]].assign(z=-1.5), axis=1)
    noise = 0.5 * np.random.default_rng(5).standard_normal(len(links))
    table = links.assign(path_loss_db=30 + 35 * np.log10(distance) + noise, part=np.arange(len(links)) % 4)
    result = calibrate(
        planted.study(tmp_path, table, holdout={"where": "part > 0"}, offset={}), engine=planted.engine()
    )
    assert result.links.held_out.sum() >= 8
    assert result.prediction.model.name == Model.LOG_DISTANCE
    assert result.predict(links) == pytest.approx(30 + 35 * np.log10(distance), abs=3.0)


def initial_campaign() -> tuple[dict[str, float], pd.DataFrame]:
    """The initial values of the parameters, and links whose true materials have these, with 2 dB of noise."""
    parameters, links = planted.engine().parameters, planted.links()
    initial = dict(zip(parameters.names, parameters.start.tolist(), strict=True))
    noise_db = 2 * np.random.default_rng(1).standard_normal(len(links))
    return initial, links.assign(path_loss_db=planted.path_loss(initial) + noise_db)


def test_initial_materials_that_a_filter_chooses_are_averaged_too(tmp_path: Path) -> None:
    initial, table = initial_campaign()
    table = table.assign(part=np.arange(len(table)) % 3)
    result = calibrate(planted.study(tmp_path, table, holdout={"where": "part > 0"}), engine=planted.engine())
    model = result.prediction.model
    assert model.name == Model.AVERAGE_INITIAL
    assert model.averaged == pytest.approx(initial)
    assert min(abs(model.parameters[name] - value) for name, value in initial.items()) > 0.01
    held_out = result.links[result.links.held_out]
    error_db = held_out.predicted_db - held_out.measured_db
    assert model.residual_db == pytest.approx(np.sqrt(np.mean(error_db**2)))


def test_a_verdict_never_contradicts_its_value() -> None:
    interval = Interval(0.1, 1.5, 4.123, Verdict.IDENTIFIED)
    assert consistent(interval, 3.0) == interval
    contradicted = consistent(interval, 14.99)
    assert contradicted.verdict == Verdict.AMBIGUOUS
    assert contradicted.reason is not None
    assert contradicted.reason.kind == ReasonKind.OUTSIDE_INTERVAL
    assert "14.99, is outside the interval" in reason_text(contradicted.reason)
    unknown = replace(interval, verdict=Verdict.NOT_IDENTIFIABLE)
    assert consistent(unknown, 14.99) == unknown


def test_initial_materials_that_blocks_choose_are_averaged_with_the_model_with_a_prior(
    tmp_path: Path,
) -> None:
    (initial, table), links = initial_campaign(), planted.links()
    result = calibrate(planted.study(tmp_path, table, holdout={"blocks": 4}), engine=planted.engine())
    model, errors = result.prediction.model, result.held_out.errors
    assert model.name == Model.AVERAGE_INITIAL
    assert Model.AVERAGE_INITIAL in result.held_out.table.index
    assert errors[Model.AVERAGE_INITIAL] == pytest.approx(
        (errors[Model.INITIAL] + 2 * errors[Model.PRIOR]) / 3, nan_ok=True
    )
    assert model.residual_db == pytest.approx(np.sqrt(np.nanmean(errors[Model.AVERAGE_INITIAL] ** 2)))
    assert model.averaged == pytest.approx(initial)
    assert min(abs(model.parameters[name] - value) for name, value in initial.items()) > 0.01
    # The prediction is the weighted mean of the predictions of both models; only the initial materials have terms.
    alone = [
        replace(model, averaged=None, parameters=values, terms=terms)
        for values, terms in (
            (model.parameters, ()),
            (model.averaged, tuple(_scaled(term, 3) for term in model.terms)),
        )
    ]
    both = [replace(result, prediction=replace(result.prediction, model=one)).predict(links) for one in alone]
    assert np.abs(both[0] - both[1]).max() > 0.3
    assert result.predict(links) == pytest.approx((2 * both[0] + both[1]) / 3, abs=1e-9)
    assert result.links.predicted_db.to_numpy() == pytest.approx(result.predict(links), abs=1e-6)
    half = result.predict_interval(links)
    assert half["path_loss_db"].to_numpy() == pytest.approx(result.predict(links), abs=1e-9)
    result.save(tmp_path / "out")
    assert Result.load(tmp_path / "out").predict(links) == pytest.approx(result.predict(links), abs=1e-9)
    assert (
        "materials calibrated with a prior, averaged with the initial materials (weight 1/3), and the fitted constant"
        in prediction_text(result)
    )
    assert "average" in scene_alone_text(result)


def test_a_chosen_distance_law_is_averaged_with_the_model_with_a_prior(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three tenths of the scene's deviations from its distance law are planted, so the errors of both cancel."""
    monkeypatch.setattr(held_out_statistics, "choose", lambda errors, position: Model.LOG_DISTANCE)
    (initial, table), links = initial_campaign(), planted.links()
    decades = np.log10(np.linalg.norm(links[["rx_x", "rx_y"]].assign(z=-1.5), axis=1))
    scene_db = planted.path_loss(initial)
    law_db = np.polyval(np.polyfit(decades, scene_db, 1), decades)
    table["path_loss_db"] = 0.3 * scene_db + 0.7 * law_db
    result = calibrate(planted.study(tmp_path, table, holdout={"blocks": 4}), engine=planted.engine())
    model, errors = result.prediction.model, result.held_out.errors
    assert model.name == Model.AVERAGE_LOG_DISTANCE
    average = (errors[Model.LOG_DISTANCE] + errors[Model.PRIOR]) / 2
    assert errors[model.name] == pytest.approx(average, nan_ok=True)
    assert model.averaged is None
    predicted_db = result.predict(links)
    assert result.links.predicted_db.to_numpy() == pytest.approx(predicted_db, abs=1e-6)
    # The two parts of the prediction, each with its whole terms.
    law = replace(
        model, name=Model.LOG_DISTANCE, parameters=None, terms=tuple(_scaled(term, 2) for term in model.terms)
    )
    scene = replace(model, name=Model.PRIOR, terms=())
    both = [
        replace(result, prediction=replace(result.prediction, model=one)).predict(links)
        for one in (law, scene)
    ]
    assert predicted_db == pytest.approx((both[0] + both[1]) / 2, abs=1e-9)
    assert np.abs(both[0] - both[1]).max() > 1.0
    result.save(tmp_path / "out")
    assert Result.load(tmp_path / "out").predict(links) == pytest.approx(predicted_db, abs=1e-9)
    assert "calibrated with a prior, averaged with the log-distance model" in prediction_text(result)
    assert "the average with another model" in scene_alone_text(result)


def _scaled(term: FittedTerm, factor: float) -> FittedTerm:
    return replace(term, coefficients={label: factor * value for label, value in term.coefficients.items()})


def test_the_mean_of_terms_keeps_groups_that_one_model_lacks() -> None:
    offset = FittedTerm("offset", "constant", "street", {"a": 2.0, "b": 4.0}, 0.0, 3.0)
    more = (
        replace(offset, coefficients={"a": 6.0, "c": 1.0}),
        FittedTerm("tx", "constant", "tx", {"1": 5.0}, 0.0, 4.0),
    )
    assert averaged_terms((offset,), more) == (
        replace(offset, coefficients={"b": 4.0, "a": 4.0, "c": 1.0}),
        FittedTerm("tx", "constant", "tx", {"1": 2.5}, 0.0, 2.0),
    )
    assert averaged_terms((offset,), more, 0.75) == (
        replace(offset, coefficients={"b": 4.0, "a": 3.0, "c": 1.0}),
        FittedTerm("tx", "constant", "tx", {"1": 1.25}, 0.0, 1.0),
    )
