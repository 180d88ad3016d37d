"""The study folder of the window: names of uploads, and a study that is changed with its reasons kept."""

from __future__ import annotations

import os

import numpy as np
import pandas as pd
import pytest
from nicegui import Client, ui
from nicegui.page import page

from calibray.errors import InputError
from calibray.study import Study
from calibray.window.desk import Desk, StudyFolder, plan, sites, solid
from calibray.window.result_steps import write_links
from calibray.window.study_steps import _entry, likely_tables, show_measurements, show_parameters, show_scene
from small_scenes import block, write_scene

STUDY = """version = 1

[scene]
file = "sionna:box"
frequency = 3.5e9  # given # twice

[links]  # offsets of cables
file = "links # 1.csv"
tx = ["tx_x", "tx_y", 2.0]
rx = ["rx_x", "rx_y", 1.5]
value = "loss"  # the only column of its kind

[parameters]
"walls.relative_permittivity" = { bounds = [1.5, 12.0] }
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    return StudyFolder(tmp_path)


@pytest.mark.parametrize(
    "name",
    [
        "../up.csv", "/etc/passwd.csv", "a/b.csv", "a\\b.csv", "..", ".hidden.csv", "nul\x00.csv", "line\nbreak.csv",
        "<script>.csv", "a" * 300 + ".csv", "study.toml", "run.py", "page.html", "", "\u202evsc.csv", "-o.csv",
        "a.csv ",
    ],
)  # fmt: skip
def test_hostile_names_of_uploads_are_refused(folder, name):
    with pytest.raises(InputError):
        folder.check_upload(name)


def test_an_upload_replaces_nothing_and_follows_no_link(folder, tmp_path):
    assert folder.check_upload("Messung März (2).csv") == tmp_path / "Messung März (2).csv"
    # As some systems write it: a letter and a mark.
    assert folder.check_upload("Mo\u0308bel.csv") == tmp_path / "M\u00f6bel.csv"
    assert folder.check_upload("नक्शा.osm") == tmp_path / "नक्शा.osm"
    for name in ("drive.txt", "scanner.tsv", "levels.dat", "houses.fgb", "sector.pln"):
        assert folder.check_upload(name) == tmp_path / name
    assert folder.check_upload("wall.ply") == tmp_path / "meshes" / "wall.ply"
    (tmp_path / "there.csv").write_text("")
    (tmp_path / "link.csv").symlink_to(tmp_path / "nowhere")
    for name in ("there.csv", "link.csv"):
        with pytest.raises(InputError, match="already exists"):
            folder.check_upload(name)


@pytest.mark.parametrize(
    ("name", "message"), [("図" * 90 + ".csv", "too long"), ("a, ü.csv", r"'a, ü\.csv': use")]
)
def test_the_reason_for_which_a_name_is_refused_shows_it(folder, name, message):
    with pytest.raises(InputError, match=message):
        folder.check_upload(name)


def test_reasons_are_read_from_comments_only(folder):
    assert folder.reasons() == {
        "scene.frequency": "given # twice",
        "links": "offsets of cables",
        "links.value": "the only column of its kind",
    }


def test_a_changed_study_keeps_its_reasons_and_a_wrong_one_is_not_written(folder):
    content, before = folder.content(), folder.text()
    content["links"]["value"] = "other"
    with pytest.raises(InputError, match="frequency"):
        folder.save({**content, "scene": {"file": "sionna:box", "frequency": -1.0}})
    assert folder.text() == before
    folder.save(content)
    assert folder.content() == content
    assert folder.reasons()["links.value"] == "the only column of its kind"


@pytest.mark.parametrize(
    "wrong", ['bounds = "x"', "bounds = [1, 2, 3]", "bounds = 1979-05-27", "bounds = [1.5"]
)
def test_of_a_file_that_is_not_a_study_the_page_shows_no_values(folder, wrong):
    assert folder.valid_content() == folder.content()
    folder.study_file.write_text(STUDY.replace("bounds = [1.5, 12.0]", wrong))
    assert folder.valid_content() == {}


def test_a_study_with_an_error_need_not_be_drafted_again(folder):
    for text, shown in (
        (
            STUDY.replace("version = 1", "version = = 1"),
            "study.toml has an error, which is shown under Measurements.",
        ),
        (STUDY + "[trcae]", "study.toml has an error, which is shown under Measurements."),
        (None, "Draft the study first."),
    ):
        folder.study_file.unlink(missing_ok=True) if text is None else folder.study_file.write_text(text)
        with Client(page("/")) as client:
            show_parameters(Desk(folder))
        texts = [part.text for part in client.elements.values() if isinstance(part, ui.label)]
        assert len(texts) == 1
        assert texts[0].startswith(shown)


def test_a_carrier_that_is_no_number_is_named_and_starts_nothing(tmp_path, monkeypatch):
    (tmp_path / "links.csv").write_text("rx_x,rx_y,loss\n1,2,90\n")
    shown, started = [], []
    monkeypatch.setattr(ui, "notify", lambda text, **_: shown.append(text))
    monkeypatch.setattr(Desk, "start", lambda _, words: started.append(words[-1]))
    with Client(page("/")) as client:
        show_measurements(Desk(StudyFolder(tmp_path), scene="scene.xml"))
        parts = list(client.elements.values())
        field = next(part for part in parts if part.props.get("label") == "Carrier frequency [Hz]")
        button = next(part for part in parts if isinstance(part, ui.button))
        (press,) = button._event_listeners.values()
        for value in ("2,44 GHz", "2.44e9"):
            field.value = value
            press.handler(None)
    assert shown == ["Carrier frequency [Hz]: 2,44 GHz: must be a number such as 2.44e9"]
    assert started == ["--frequency=2.44e9"]


def test_the_latest_result_is_the_last(folder, tmp_path):
    for second, name in enumerate(("result-2", "result-10", "result-9")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "result.json").write_text("{}")
        os.utime(tmp_path / name / "result.json", (0, second))
    assert folder.results() == ["result-2", "result-10", "result-9"]


def test_results_are_named_by_folders_with_a_record(folder, tmp_path):
    (tmp_path / "result").mkdir()
    (tmp_path / "result" / "result.json").write_text('{"fit": {}}')
    (tmp_path / "other").mkdir()
    assert folder.results() == ["result"]
    assert folder.result("result") == {"fit": {}}
    with pytest.raises(InputError, match="no such result"):
        folder.result("../result")


RSSI = "Time\tLatitude\tLongitude\tCell name\tRSRP (dBm)\n" + "".join(
    f"10:0{k}\t50.0{k}\t14.4{k}\t{'AB'[k % 2]}\t-{80 + k}\n" for k in range(6)
)
TRANSMITTERS = "Cell name\tLat\tLon\tEIRP (dBm)\nA\t50.0\t14.4\t46\nB\t50.1\t14.5\t46\n"


def test_tables_of_links_and_transmitters_are_told_apart_by_their_columns(tmp_path):
    names = {
        "aps.tsv": TRANSMITTERS, "masts.txt": RSSI, "places.csv": "Latitude,Longitude\n50.0,14.4\n",
        "place.csv": RSSI, "drive-predicted.csv": RSSI,
    }  # fmt: skip
    for name, text in names.items():
        (tmp_path / name).write_text(text)
    folder = StudyFolder(tmp_path)
    assert folder.tables() == ["aps.tsv", "masts.txt", "places.csv"]
    assert likely_tables(folder, folder.tables()) == ("masts.txt", "aps.tsv")
    assert likely_tables(folder, ["places.csv"]) == ("places.csv", "")


def test_tables_whose_columns_show_nothing_are_told_apart_by_their_names(tmp_path):
    for name in ("cells.csv", "plan.csv", "rounds.csv"):
        (tmp_path / name).write_text("a,b\n1,2\n")
    folder = StudyFolder(tmp_path)
    assert likely_tables(folder, folder.tables()) == ("rounds.csv", "cells.csv")


def test_sectors_of_one_mast_are_separate_transmitters(tmp_path):
    east, south = {"cell": "east", "azimuth": 90, "tilt": 4.0}, {"cell": "south", "azimuth": 180, "tilt": 6.5}
    rows = [cell | {"rx_x": x, "loss": 80.0 + x} for x in (20.0, 40.0) for cell in (east, south)]
    pd.DataFrame(rows).to_csv(tmp_path / "log.csv", index=False)
    angles = {"azimuth_deg": "azimuth", "downtilt_deg": "tilt"}
    links = {
        "file": "log.csv",
        "tx": [0, 0, 25],
        "rx": ["rx_x", 5, 1.5],
        "value": "loss",
        "tx_antenna": angles,
    }
    content = {
        "version": 1, "scene": {"file": "scene.xml", "frequency": 2e9}, "links": links, "offset": {"per": "cell"},
        "parameters": {"walls.relative_permittivity": {"bounds": [2, 9]}},
    }  # fmt: skip
    study = Study.from_content(content, tmp_path / "study.toml")
    found = sites(study, study.measurements())
    assert [site["name"] for site in found] == ["east at 0, 0, 25", "south at 0, 0, 25"]
    assert [site["columns"] for site in found] == [east, south]


def test_places_are_at_their_height_above_the_ground(tmp_path):
    """On a slope of 20 %, where z = 1.5 m would be under the ground."""
    slope = [[(0.0, 0.0, 0.0), (200.0, 0.0, 40.0), (200.0, 100.0, 40.0), (0.0, 100.0, 0.0)]]
    write_scene(tmp_path, {"ground": slope, "house": block((20.0, 20.0, 0.0), (40.0, 40.0, 15.0))})
    desk = Desk(StudyFolder(tmp_path), scene="scene.xml")
    site = {"tx": [0.0, 0.0, 30.0], "columns": {"sector": "north"}}
    write_links(desk, "candidates.csv", site, np.array([50.0, 100.0]), np.array([60.0]), 1.5)
    table = pd.read_csv(tmp_path / "candidates.csv")
    assert table[["rx_x", "rx_y"]].to_numpy().tolist() == [[50.0, 60.0], [100.0, 60.0]]
    assert table["rx_z"].to_numpy() == pytest.approx([11.5, 21.5])
    assert (table["tx_z"] == 30.0).all()
    assert (table["sector"] == "north").all()
    with pytest.raises(InputError, match="heights above the ground require a scene"):
        write_links(Desk(StudyFolder(tmp_path)), "place.csv", site, np.array([1.0]), np.array([1.0]), 1.5)


def test_what_a_parameter_states_is_kept():
    """A prior of another revision of P.2040 than the list's, and negative bounds within reach of the sliders."""
    with Client(page("/")) as client:
        for name, entry in (
            ("walls.relative_permittivity", {"bounds": [1.5, 12.0], "prior": {"itu": "brick@P.2040-1", "spread": 0.2}}),
            ("floor.relative_permittivity", {"bounds": [1.5, 12.0], "prior": {"itu": "wood", "spread": 0.3}}),
            ("tx:A.azimuth", {"bounds": [-10.0, 10.0]}),
        ):  # fmt: skip
            assert _entry(name, entry)() == entry
    for slider in (part for part in client.elements.values() if isinstance(part, ui.slider)):
        assert slider.props["min"] <= slider.value <= slider.props["max"]


OF_MAPS = {
    "Walls (ITU-R P.2040)",
    "Thickness of walls [m]",
    "Ground",
    "Height model of the ground",
    "One mesh per building",
}


@pytest.mark.parametrize(
    ("chosen", "settings"),
    [
        ("osm", OF_MAPS),
        ("footprints", {"Height: a column, or metres", *OF_MAPS}),
        ("plan", {"Height: a column, or metres", "Unit of a plan [m]", "Materials of a plan"}),
    ],
)
def test_only_the_settings_of_the_chosen_kind_of_map_are_shown(tmp_path, chosen, settings):
    (tmp_path / "houses.geojson").write_text("{}")
    with Client(page("/")) as client:
        show_scene(Desk(StudyFolder(tmp_path)))
    fields = {
        part.props.get("label") or part.text: part
        for part in client.elements.values()
        if hasattr(part, "value")
    }
    fields.pop("Kind").value = chosen
    assert {name for name, field in fields.items() if field.visible} >= settings
    hidden = {"Height: a column, or metres", "Unit of a plan [m]", "Materials of a plan", *OF_MAPS} - settings
    assert not any(fields[name].visible for name in hidden)


@pytest.mark.parametrize("centre", [{"value": 5.0}, {"like": "walls.relative_permittivity"}])
def test_the_spread_of_a_prior_without_a_material_can_be_changed(centre):
    with Client(page("/")) as client:
        read = _entry(
            "floor.relative_permittivity", {"bounds": [1.5, 12.0], "prior": {**centre, "spread": 0.2}}
        )
    spread = next(
        part for part in client.elements.values() if part.props.get("label") == "Spread of the prior"
    )
    assert read()["prior"] == {**centre, "spread": 0.2}
    spread.value = 0.5
    assert read()["prior"] == {**centre, "spread": 0.5}


def test_the_map_has_the_materials_of_the_study(tmp_path):
    """P.2040 has no brick at 60 GHz, so the scene alone could not be read there; the study states its constants."""
    bsdf = '<bsdf type="itu-radio-material" id="mat-stone"><string name="type" value="brick"/></bsdf>'
    write_scene(tmp_path, {"house": block((20.0, 20.0, 0.0), (40.0, 40.0, 15.0))}, bsdf)
    (tmp_path / "links.csv").write_text("rx_x,rx_y,loss\n1,2,90\n3,4,95\n")
    (tmp_path / "study.toml").write_text(
        """version = 1
scene = { file = "scene.xml", frequency = 60e9 }
links = { file = "links.csv", tx = [0.0, 0.0, 9.0], rx = ["rx_x", "rx_y", 1.5], value = "loss" }
[materials]
stone = { relative_permittivity = 4.0, conductivity = 0.1, thickness = 0.2 }
[objects]
front = "house"
[parameters]
"front.relative_permittivity" = { bounds = [1.5, 12.0] }
"""
    )
    folder = StudyFolder(tmp_path)
    shown = plan(folder, None)
    assert len(shown["links"]) == 2
    # Without columns of transmitters, groups or carriers, a mast has only its position.
    assert shown["sites"] == [{"name": "at 0, 0, 9", "tx": [0.0, 0.0, 9.0], "columns": {}}]
    assert list(solid(folder, None).meshes) == ["front"]
