"""The validation of a result: stored and read back, refused if damaged, shown in the report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import shown
from calibray.errors import InputError
from calibray.reporting.page import page
from calibray.reporting.summary import summary
from calibray.reporting.trust_figures import trust_figures
from calibray.result.files import VALIDATION_FILE, read_validation, write_validation
from calibray.result.held_out import Model
from calibray.study import Study
from calibray.validation.validation import Validation
from made_up_report import made_up

LINKS = 60
MEASURED = np.linspace(80, 120, LINKS)
STUDY = made_up(2, 1)[0].study


@pytest.fixture(scope="module")
def validation() -> Validation:
    random = np.random.default_rng(0)
    block = np.where(np.arange(LINKS) < 5, -1, np.arange(LINKS) % 3)
    errors = {
        name: size * random.standard_normal(LINKS)
        for name, size in ((Model.INITIAL, 6), (Model.CALIBRATED, 2), (Model.LOG_DISTANCE, 8))
    }
    errors[Model.LOG_DISTANCE][:5] = np.nan
    return Validation(("west", "<b>", "east"), block, errors, random.uniform(0, 300, (LINKS, 3)), MEASURED)


def test_a_validation_is_read_back(validation, tmp_path):
    write_validation(validation, STUDY, tmp_path, validation.content())
    errors = read_validation(tmp_path, STUDY, MEASURED)
    assert errors is not None
    stored = Validation.of(errors)
    assert stored.table.to_numpy() == pytest.approx(validation.table.to_numpy(), abs=1e-3)
    assert stored.sentence == validation.sentence
    assert stored.labels == validation.labels
    assert read_validation(tmp_path / "none", STUDY, MEASURED) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content.update(version=9), "version 9"),
        (lambda content: content["links"]["block"].pop(), "block must have one value per link"),
        (lambda content: content["links"].update(block=[7] * LINKS), "blocks or positions"),
        (lambda content: content["links"]["errors_db"][Model.CALIBRATED].__setitem__(20, None), "is missing"),
        (lambda content: content["links"].update(errors_db={}), "is not a validation"),
        (lambda content: content.pop("links"), "is not a validation"),
        (lambda content: content.update(links=[]), "is not a validation"),
    ],
)
def test_a_damaged_validation_is_refused(validation, tmp_path, change, words):
    write_validation(validation, STUDY, tmp_path, validation.content())
    content = json.loads((tmp_path / VALIDATION_FILE).read_text())
    change(content)
    (tmp_path / VALIDATION_FILE).write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        read_validation(tmp_path, STUDY, MEASURED)


def test_a_validation_of_another_study_or_of_other_measurements_is_refused(validation, tmp_path):
    write_validation(validation, STUDY, tmp_path, validation.content())
    other = STUDY.replace(method="gwo", seed=7)
    assert read_validation(tmp_path, other, MEASURED) is not None
    content = STUDY.content()
    content["scene"]["frequency"] = 7e9
    for study, measured in ((Study.from_content(content), MEASURED), (STUDY, MEASURED + 0.1)):
        with pytest.raises(InputError, match="does not belong to the study and the measurements"):
            read_validation(tmp_path, study, measured)


def test_a_validation_of_other_links_is_refused_before_it_replaces_that_of_a_result(validation, tmp_path):
    result = shown.result()
    validation = replace(validation, measured_db=result.links["measured_db"].to_numpy())
    result.save(tmp_path)
    write_validation(validation, result.study, tmp_path, {})
    written = (tmp_path / VALIDATION_FILE).read_text()
    twice = replace(validation, measured_db=np.tile(validation.measured_db, 2))
    content = result.study.content()
    content["scene"]["frequency"] = 7e9
    for other, study, words in (
        (twice, result.study, r"different links \(12"),
        (validation, Study.from_content(content), "belongs to another study"),
    ):
        with pytest.raises(InputError, match=words):
            write_validation(other, study, tmp_path, {})
    assert (tmp_path / VALIDATION_FILE).read_text() == written


def test_parameters_that_opening_adds_do_not_change_the_study(validation, tmp_path):
    content = STUDY.content()
    name = next(iter(content["parameters"]))
    prior = {"std": 7.0, "shared": True}
    added = {"tx:S1.azimuth": {**content["parameters"][name], "bounds": [-40.0, 40.0], "prior": prior}}
    opened = Study.from_content(
        content
        | {
            "parameters": content["parameters"] | added,
            "links": content["links"] | {"tx_antenna": {"azimuth_deg": "azimuth"}},
        }
    )
    alone = Study.from_content(opened.content() | {"parameters": content["parameters"]})
    write_validation(validation, alone, tmp_path, {})
    assert read_validation(tmp_path, opened, MEASURED) is not None


def test_the_report_shows_the_validation(validation):
    result, shown = made_up(LINKS, 12)
    result = replace(result, held_out=validation)
    figures = trust_figures(result)
    assert {"held-out-errors", "held-out-blocks"} <= set(figures)
    text = page(result, shown, figures)
    assert "figure-held-out-errors" in text
    assert "3 blocks held out in turn" in text
    assert "<b>" not in text.partition('id="validation"')[2].partition("</section>")[0].replace(
        "&lt;b&gt;", ""
    )
    helped = next(part for part in summary(result) if part.heading.startswith("Did calibration help"))
    assert validation.sentence in helped.text
    assert helped.kind == "good"
    assert "calibray validate STUDY" in page(replace(result, held_out=None), shown, {})


def test_saving_a_result_removes_an_earlier_validation_and_says_so(validation, tmp_path: Path, caplog):
    write_validation(validation, STUDY, tmp_path, validation.content())
    result, _ = made_up(LINKS, 12)
    replace(result, held_out=None).save(tmp_path)
    assert not (tmp_path / VALIDATION_FILE).exists()
    assert f"{VALIDATION_FILE}: removed" in caplog.text
    caplog.clear()
    replace(result, held_out=None).save(tmp_path)
    replace(result, held_out=validation).save(tmp_path)
    assert not caplog.text
    assert (tmp_path / VALIDATION_FILE).exists()
