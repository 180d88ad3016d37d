"""The steps that a study names turn rows of a log into links."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.measurements import POSITION_COLUMNS, SourceTable
from calibray.scenes.authoring import Footprints, Terrain, make_scene
from calibray.study import Setup, Study, row_steps

FRAME = Frame.local(9.99, 50.01)
SITES = {"a": (0.0, 0.0, 20.0), "b": (60.0, 0.0, 15.0)}
STUDY: dict = {
    "version": 1,
    "scene": {"file": "scene.xml", "frequency": 3.5e9},
    "links": {
        "file": "log.csv",
        "tx": ["site_lon", "site_lat", "height"],
        "rx": ["lon", "lat", 1.5],
        "value": "rsrp",
        "quantity": "rsrp",
        "position": "geographic",
        "transmitters": "sites.csv",
        "transmitter": "site",
    },
    "parameters": {"walls.relative_permittivity": {"bounds": [1.5, 12.0]}},
    "offset": {"per": ["site", "phone"]},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene of one house, 20 m wide, about (30, 0), and a log around it."""
    import shapely

    target = tmp_path_factory.mktemp("prepared")
    box = np.array([shapely.box(20, -10, 40, 10)])
    make_scene(
        Footprints(box, np.zeros(1), np.full(1, 9.0), ("house",), ("height",), np.zeros(1, bool), {}),
        target,
        FRAME,
    )
    places = {
        (x, y): FRAME.to_geographic([(x, y, 0.0)])[0] for x, y in [(5, 20), (8, 22), (38.5, 0), (50, 20)]
    }
    rows = [
        (phone, f"{lon:.8f}", f"{lat:.8f}", site, -80.0 - x / 10 - (site == "b") - 3 * (phone == "p2"))
        for (x, _), (lon, lat, _) in places.items()
        for site in SITES
        for phone in ("p1", "p2")
    ]
    log = pd.DataFrame(rows, columns=["phone", "lon", "lat", "site", "rsrp"])
    log.to_csv(target / "log.csv", index=False)
    sites = pd.DataFrame(
        [(name, *FRAME.to_geographic([place])[0]) for name, place in SITES.items()],
        columns=["site", "lon", "lat", "height"],
    )
    sites.to_csv(target / "sites.csv", index=False, float_format="%.8f")
    return target


def study(folder, **links) -> Study:
    content = json.loads(json.dumps(STUDY))
    content["links"] |= links
    return Study.from_content(content, folder / "study.toml")


def test_geographic_positions_become_metres_in_the_scene(folder):
    links = study(folder).measurements()
    assert len(links) == 16
    assert links.rx[0] == pytest.approx([5, 20, 1.5], abs=0.01)
    assert links.tx[2] == pytest.approx([60, 0, 15], abs=0.01)
    assert links.group_names == ("a p1", "a p2", "b p1", "b p2")
    # The offset absorbs the transmitted power: the loss is minus the received power.
    assert links.path_loss_db[:2].tolist() == [80.5, 83.5]
    assert links.prepared == {}


def test_the_frame_of_the_study_overrides_that_of_the_scene_file(folder):
    content = json.loads(json.dumps(STUDY))
    east = FRAME.to_geographic([(10.0, 0.0, 0.0)])[0]
    content["scene"]["origin"] = east[:2].tolist()
    moved = Study.from_content(content, folder / "study.toml").measurements()
    assert moved.rx[0] == pytest.approx([-5, 20, 1.5], abs=0.01)
    content["scene"]["crs"] = "EPSG:32632"
    in_zone = Study.from_content(content, folder / "study.toml").measurements()
    # The zone's scale and convergence add centimetres and fractions of a degree this close to its meridian.
    assert in_zone.rx[0] == pytest.approx([-5, 20, 1.5], abs=0.3)


def test_positions_to_predict_at_are_read_as_measured_ones(folder, monkeypatch):
    """The same columns mean the same without measured values, and no row is left out."""
    monkeypatch.setattr(row_steps, "_ground", lambda _: lambda x, y: 0.1 * x + 2.0 * y)
    plan = study(folder, heights="ground", where="site == 'a'", inside="drop")
    measured, log = plan.measurements(), pd.read_csv(folder / "log.csv").drop(columns="rsrp")
    links = plan.places(SourceTable(log, source="new.csv"))
    assert len(links) == len(log) == 16
    kept = (log.site == "a").to_numpy() & (np.abs(links.rx[:, 0] - 38.5) > 0.4)
    assert links.rx[kept] == pytest.approx(measured.rx)
    assert links.tx[kept] == pytest.approx(measured.tx)
    assert links.rx[0, 2] == pytest.approx(1.5 + 0.5 + 40.0, abs=0.01)
    assert links.group is not None
    assert links.group[:3].tolist() == ["a p1", "a p2", "b p1"]
    assert not links.measured
    # Columns in metres take precedence.
    metres = log.assign(**{name: k + 1.0 for k, name in enumerate(POSITION_COLUMNS)})
    assert plan.places(SourceTable(metres)).rx[3].tolist() == [4.0, 5.0, 6.0]
    with pytest.raises(InputError, match=r"new\.csv.*no column 'site'"):
        plan.places(SourceTable(log.drop(columns="site"), source="new.csv"))
    with pytest.raises(InputError, match="no column 'tx_x'"):
        plan.places(SourceTable(log[["phone"]], source="new.csv"))


def test_positions_of_transmitters_come_from_their_table_in_predictions_too(folder, caplog):
    """A column of the new table has the name of a coordinate of the transmitters."""
    log = pd.read_csv(folder / "log.csv").drop(columns="rsrp")
    links = study(folder).places(SourceTable(log.assign(height=1.5), source="new.csv"))
    assert links.tx[:, 2] == pytest.approx(study(folder).places(SourceTable(log)).tx[:, 2])
    assert "new.csv: column height is ignored, because the calibration took this column from" in caplog.text
    # A column that the measured links have themselves is theirs in predictions too.
    (folder / "own.csv").write_text((folder / "log.csv").read_text().replace("rsrp", "height"))
    own = study(folder, file="own.csv", value="height").places(SourceTable(log.assign(height=12.0)))
    assert own.tx[:, 2] == pytest.approx(12.0, abs=0.01)


def test_the_study_s_own_table_is_not_taken_for_one_in_metres_without_a_word(folder, monkeypatch, caplog):
    """Its columns have the names of positions in the scene's frame, but other units or heights."""
    monkeypatch.setattr(row_steps, "_ground", lambda _: lambda x, y: 0.1 * x)
    content = json.loads(json.dumps(STUDY))
    content["links"] |= {"position": "scene", "tx": [0.0, 0.0, 20.0], "rx": ["rx_x", "rx_y", "rx_z"]}
    content["links"] |= {"transmitters": None, "transmitter": "transmitter"}
    table = pd.DataFrame({name: [k + 1.0] for k, name in enumerate(POSITION_COLUMNS)})
    table = table.assign(site="a", phone="p1")
    for changed, values, warned in (
        ({"heights": "ground"}, {"rsrp": -80.0}, True),
        ({"position_unit": 0.01}, {"rsrp": -80.0}, True),
        ({}, {"rsrp": -80.0}, False),
        ({"heights": "ground"}, {"path_loss_db": 80.0}, False),  # a table that Calibray wrote
    ):
        caplog.clear()
        links = {name: value for name, value in content["links"].items() if value is not None} | changed
        plan = Study.from_content(content | {"links": links}, folder / "study.toml")
        plan.places(SourceTable(table.assign(**values)))
        assert ("rename rx_x, rx_y, rx_z in both tables" in caplog.text) == warned


@pytest.mark.parametrize(
    ("inside", "left", "counts"),
    [
        ("keep", 16, {}),
        ("drop", 12, {"receivers inside buildings, left out": 4}),
        ("move", 16, {"receivers inside buildings, moved out": 4}),
    ],
)
def test_receivers_inside_buildings(folder, inside, left, counts):
    links = study(folder, inside=inside).measurements()
    assert (len(links), links.prepared) == (left, counts)
    if inside == "move":
        assert links.rx[8] == pytest.approx([41, 0, 1.5], abs=0.01)


def test_receivers_moved_out_of_a_building_on_a_slope_keep_their_height_above_the_ground(tmp_path):
    """A slope of 20 %; two receivers move by 3 m up and by 13 m down."""
    import shapely

    axis = np.linspace(-100, 200, 61)
    slope = Terrain(axis, axis, np.add.outer(0.0 * axis, 0.2 * axis))
    box = np.array([shapely.box(0, 0, 30, 100)])
    house = Footprints(box, np.zeros(1), np.full(1, 9.0), ("house",), ("height",), np.zeros(1, bool), {})
    make_scene(house, tmp_path, FRAME, terrain=slope)
    table = pd.DataFrame({"x": [28.0, 12.0, 40.0], "y": 50.0, "path_loss_db": 90.0})
    table.to_csv(tmp_path / "links.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": 3.5e9},
        "links": {
            "file": "links.csv", "tx": [100, 0, 20], "rx": ["x", "y", 1.5], "value": "path_loss_db",
            "heights": "ground", "inside": "move",
        },
        "parameters": STUDY["parameters"],
        "offset": {},
    }  # fmt: skip
    rx = Study.from_content(content, tmp_path / "study.toml").measurements().rx
    assert rx[:, 0] == pytest.approx([31.0, -1.0, 40.0])
    assert rx[:, 2] - slope.heights(rx[:, 0], rx[:, 1]) == pytest.approx(1.5)


def test_averages_stay_within_transmitter_and_group(folder):
    links = study(folder, average={"by": "cell", "size": 25.0}).measurements()
    # (5, 20) and (8, 22) share a cell.
    assert len(links) == 12
    assert links.prepared == {"samples averaged": 16}
    first = links.frame.iloc[0]
    assert first["count"] == 2
    assert links.rx[0] == pytest.approx([6.5, 21, 1.5], abs=0.01)
    mean = 10 * np.log10((10**-8.05 + 10**-8.08) / 2)
    assert links.path_loss_db[0] == pytest.approx(-mean)
    assert first["std_db"] == pytest.approx(np.std([80.5, 80.8], ddof=1))


@pytest.mark.parametrize(
    ("links", "message"),
    [
        ({"transmitter": "phone"}, "no column 'phone'"),
        ({"noise_floor_dbm": -10.0}, "no row remains"),
        ({"quantity": "path_loss", "noise_floor_dbm": -100.0}, "is a received power"),
        ({"average": {"by": "time", "size": 3.0}}, "needs time"),
        ({"quantity": "received_power"}, "set quantity = 'rsrp' and add an \\[offset\\]"),
        ({"position": "scene"}, "set position = 'geographic'"),
        ({"transmitters": "nowhere.csv"}, "no such file"),
    ],
)
def test_faulty_links_sections_are_refused(folder, links, message):
    with pytest.raises(InputError, match=message):
        study(folder, **links).measurements()


def test_an_unknown_transmit_power_needs_an_offset(folder):
    content = {key: value for key, value in STUDY.items() if key != "offset"}
    with pytest.raises(InputError, match=r"links\.quantity = 'rsrp' needs \[offset\]"):
        Study.from_content(content, folder / "study.toml")


def test_a_column_of_labels_is_missed_before_anything_is_traced(folder):
    content = json.loads(json.dumps(STUDY))
    for by, links in (("phone", 16), ("tx", 16), ("out_of_sight", 16)):
        opened = Setup.open(Study.from_content(content | {"holdout": {"by": by}}, folder / "study.toml"))
        assert len(opened.links) == links
    with pytest.raises(InputError, match=r"log.csv with .*sites.csv: no column 'street'"):
        Setup.open(Study.from_content(content | {"holdout": {"by": "street"}}, folder / "study.toml"))


def test_geographic_positions_need_a_scene_with_an_origin(folder):
    (folder / "bare.xml").write_text("".join(
        line for line in (folder / "scene.xml").read_text().splitlines(True) if "calibray frame" not in line
    ))  # fmt: skip
    content = json.loads(json.dumps(STUDY))
    content["scene"]["file"] = "bare.xml"
    with pytest.raises(InputError, match=r"scene\.origin = \[longitude, latitude\]"):
        Study.from_content(content, folder / "study.toml").measurements()


def test_tables_for_prediction_are_read_like_the_measured_one(folder, tmp_path):
    """A wide table with an index column: every cell is a link, with or without a value."""
    plan = study(folder, wide={"rss a": "a", "rss b": "b"}, value="rss")
    log = pd.read_csv(folder / "log.csv").drop_duplicates(["lon", "lat"])[["phone", "lon", "lat"]]
    wide = log.assign(**{"Unnamed: 0": range(4), "rss a": [-70.0, np.nan, 100.0, -75.0], "rss b": -80.0})
    links = plan.places(SourceTable(wide.reset_index(drop=True)))
    assert len(links) == 8
    assert links.group_names == ("a p1", "b p1")
    assert links.frame["rss"].isna().tolist() == [False, False, True, False, True, False, False, False]
    assert links.tx[1] == pytest.approx([60, 0, 15], abs=0.01)
    # A table with one row per link is read as well.
    long = plan.places(SourceTable(pd.read_csv(folder / "log.csv")))
    assert len(long) == 16


def test_the_results_own_table_names_groups_and_carriers(folder):
    plan = study(folder, frequency="carrier")
    table = pd.DataFrame(
        dict(zip(POSITION_COLUMNS, (0.0, 0.0, 20.0, 5.0, 20.0, 1.5), strict=True)), index=[0]
    )
    links = plan.places(SourceTable(table.assign(group="a p1", frequency=28e9)))
    assert links.group.tolist() == ["a p1"]
    assert links.frequency.tolist() == [28e9]


def test_positions_in_another_unit(folder):
    """A grid of 0.6 m tiles; the receiver's height is a number, in metres."""
    metres = {"position": "scene", "transmitters": None, "position_unit": 0.6}
    plan = study(folder, tx=[0.0, 0.0, 20.0], rx=["column", "row", 1.5], **metres)
    grid = SourceTable(
        pd.DataFrame({"column": [5.0, 10.0], "row": 20.0, "site": "a", "phone": "p1", "rsrp": -80.0})
    )
    np.testing.assert_allclose(plan.places(grid).rx, [[3.0, 12.0, 1.5], [6.0, 12.0, 1.5]])
    assert plan.places(grid).tx[0].tolist() == [0.0, 0.0, 20.0]
    with pytest.raises(InputError, match=r"position_unit = 0\.6 with position = 'geographic'"):
        study(folder, position_unit=0.6)
    with pytest.raises(InputError, match="position_unit"):
        study(folder, tx=[0.0, 0.0, 20.0], rx=["column", "row", 1.5], **{**metres, "position_unit": 0.0})


def test_average_by_place_takes_no_size_and_other_averages_need_one(folder):
    links = study(folder, average="place").measurements()
    assert links.prepared == {"samples averaged": 16}
    assert len(links) == 16  # two phones, two sites, four positions
    assert study(folder, average={"by": "place"}).links == study(folder, average="place").links
    for average, message in (
        ({"by": "place", "size": 1.0}, "by = 'place' does not use size"),
        ({"by": "cell"}, "by = 'cell' needs size"),
        ({"by": "place", "minimum_count": 0}, "minimum_count"),
    ):
        with pytest.raises(InputError, match=message):
            study(folder, average=average)


def test_rows_of_groups_stay_apart_and_repeats_average_observables(tmp_path):
    """One place, two phones, two rows each, with gaps in the delay spread."""
    table = pd.DataFrame(
        {"phone": ["a", "a", "b", "b"], "ns": [10.0, 20.0, 30.0, np.nan], "loss": [80.0] * 4}
    )
    table.to_csv(tmp_path / "log.csv", index=False)
    content = STUDY | {
        "links": {"file": "log.csv", "tx": [0.0, 0.0, 9.0], "rx": [50.0, 0.0, 1.5], "value": "loss"},
        "offset": None,
    }
    spread = {"kind": "rms_delay_spread", "column": "ns", "unit": "ns"}
    cases = {
        "nuisance": {
            "nuisance": {"phones": {"by": "constant", "per": "phone"}},
            "observables": {"s": spread},
        },
        "bias": {"observables": {"s": spread | {"bias": "phone"}}},
    }
    for sections in cases.values():
        stated = {name: value for name, value in (content | sections).items() if value is not None}
        links = Study.from_content(stated, tmp_path / "study.toml").measurements()
        assert links.frame["phone"].tolist() == ["a", "b"]
        assert links.frame["ns"].tolist() == [15.0, 30.0]


@pytest.mark.parametrize("links", [{}, {"average": "place"}], ids=["merged", "averaged"])
def test_values_that_the_filter_of_an_observable_excludes_do_not_enter_the_mean(tmp_path, links):
    table = {
        "ns": [90.0, 50.0, 70.0],
        "state": ["NLOS", "LOS", "NLOS"],
        "x": [5.0, 5.0, 9.0],
        "loss": [80.0] * 3,
    }
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    spread = {"kind": "rms_delay_spread", "column": "ns", "unit": "ns"}
    section = {"file": "log.csv", "tx": [0.0, 0.0, 9.0], "rx": ["x", 0.0, 1.5], "value": "loss", **links}
    filters = {"near": "state == 'LOS'", "far": "state != 'LOS'", "free": "straight_walls == 0"}
    content = STUDY | {
        "links": section, "observables": {name: spread | {"where": text} for name, text in filters.items()}
    }  # fmt: skip
    del content["offset"]
    frame = Study.from_content(content, tmp_path / "study.toml").measurements().frame
    assert frame["ns [near]"].tolist() == pytest.approx([50.0, np.nan], nan_ok=True)
    assert frame["ns [far]"].tolist() == [90.0, 70.0]
    # The columns of this filter are computed for the links.
    assert frame["ns"].tolist() == [70.0, 70.0]
    assert "ns [free]" not in frame


@pytest.mark.parametrize("links", [{}, {"average": "place"}], ids=["merged", "averaged"])
def test_numeric_columns_that_a_study_uses_are_means_of_the_rows_of_a_link(tmp_path, links):
    table = {
        "load": [0.0, 100.0, 70.0],
        "count": 1,
        "gps_m": [1.0, 3.0, 4.0],
        "x": [5.0, 5.0, 9.0],
        "loss": [80.0] * 3,
    }
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    section = {"file": "log.csv", "tx": [0.0, 0.0, 9.0], "rx": ["x", 0.0, 1.5], "value": "loss", "std": 2.0}
    content = STUDY | {
        # A number that marks missing measurements can be a value of another column.
        "links": section | {"position_error_m": "gps_m", "missing": [0.0]} | links,
        "nuisance": {
            "load": {"by": "load"},
            "x": {"by": "x"},
            "n": {"by": "count"},
            "constant": {"by": "constant"},
        },
    }
    del content["offset"]
    frame = Study.from_content(content, tmp_path / "study.toml").measurements().frame
    assert frame[["load", "gps_m", "x"]].to_numpy().tolist() == [[50.0, 2.0, 5.0], [70.0, 4.0, 9.0]]


REPEATED = pd.DataFrame({
    "x": [10.0, 20.0, 30.0, 30.0, 10.0, 20.0], "day": [1, 1, 1, 1, 2, 2],
    "loss": [80.0, 82.0, 84.0, 84.0, 90.0, 92.0],
})  # fmt: skip


def repeated(target, holdout, **links) -> Study:
    """A log of two days, of which the second repeats two links with 10 dB more, and one row repeats another."""
    REPEATED.to_csv(target / "days.csv", index=False)
    section = {"file": "days.csv", "tx": [0.0, 0.0, 5.0], "rx": ["x", 0.0, 1.5], "value": "loss"}
    content = {**STUDY, "links": {**section, **links}, "holdout": holdout}
    return Study.from_content(
        {name: content[name] for name in content if name != "offset"}, target / "s.toml"
    )


@pytest.mark.parametrize("links", [{}, {"average": {"by": "place"}}])
@pytest.mark.parametrize("holdout", [{"where": "day == 2"}, {"by": "day"}])
def test_rows_that_are_held_out_separately_stay_separate_links(tmp_path, holdout, links):
    study = repeated(tmp_path, holdout, **links)
    found = row_steps.study_links(study)
    assert found.path_loss_db == pytest.approx(REPEATED["loss"].drop(3))
    assert found.frame["day"].tolist() == [1, 1, 1, 2, 2]
    assert (
        study.held_out(found).tolist() == (found.frame["day"] == 2).tolist() if "where" in holdout else True
    )


@pytest.mark.parametrize(
    "holdout", [{"blocks": 2}, {"by": "tx"}, {"where": "x > 15"}, {"where": "loss > 85"}]
)
def test_other_divisions_merge_rows_as_without_held_out_links(tmp_path, holdout):
    """A filter by the measured value selects finished links: it must not divide the samples of one by their level."""
    found = row_steps.study_links(repeated(tmp_path, holdout))
    powers = 10 ** (-REPEATED["loss"] / 10)
    expected = -10 * np.log10(powers.groupby(REPEATED["x"]).mean())
    assert found.path_loss_db == pytest.approx(expected)
