"""`calibray init`: what it assumes of a scene and a table is right, and what cannot be told is asked for."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from calibray.cli.app import app
from calibray.coordinates import Frame, transformer
from calibray.errors import InputError
from calibray.materials import itu_material
from calibray.measurements import SourceTable, column_names
from calibray.scenes.authoring import Footprints, Terrain, make_plan_scene, make_scene, read_plan
from calibray.scenes.checks import SceneSurfaces
from calibray.study import Study
from calibray.study.draft import Draft, Given, _share_at_lowest, schema_text
from calibray.study.draft import draft as draft_study
from calibray.study.link_checks import count_unknowns
from calibray.study.toml_file import study_text

REPOSITORY = Path(__file__).parents[2]
TOWN = REPOSITORY / "examples" / "bring_your_own"
FRAME = Frame.local(9.99, 50.01)


def draft(scene: str, links: Path, target: Path, transmitters=None, frequency=None, **given) -> Draft:
    return draft_study(scene, links, target, Given(transmitters, frequency=frequency, **given))


@pytest.fixture
def scene(tmp_path):
    """One house 20 m wide."""
    box = np.array([shapely.box(20, -10, 40, 10)])
    house = Footprints(box, np.zeros(1), np.full(1, 9.0), ("house",), ("height",), np.zeros(1, bool), {})
    return str(make_scene(house, tmp_path / "town", FRAME).path)


def table(folder: Path, **columns: object) -> Path:
    file = folder / "links.csv"
    pd.DataFrame(columns).to_csv(file, index=False)
    return file


def typed(*words: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, list(map(str, words)))
    return result.exit_code, result.stdout, result.stderr


def assumed(found) -> dict[str, str]:
    return {each.what: each.value for each in found.assumptions}


def test_a_phones_log_becomes_a_study_that_reads(scene, tmp_path):
    file = tmp_path / "study.toml"
    words = ("init", scene, TOWN / "rsrp.csv", "--transmitters", TOWN / "cells.csv", "--frequency", "3.6e9")
    picture = tmp_path / "antennas.svg"
    status, out, err = typed(*words, "-o", file, "--plot", picture)
    assert status == 0, err
    assert "1253 values are missing, and no measured value is lower" in out
    assert picture.exists()
    study = Study.load(file)
    assert study.links.quantity == "rsrp"
    assert study.links.position == "geographic"
    assert study.links.tx == ("cell_longitude", "cell_latitude", "height")
    assert study.links.noise_floor_dbm == -118.0
    assert study.offset.per == ("cell", "device")
    assert study.links.average.size == 3.3
    assert list(study.parameters) == ["roofs.relative_permittivity", "walls.relative_permittivity",
                                      "ground.relative_permittivity"]  # fmt: skip
    assert study.measurements().prepared["samples averaged"] == 3440
    text = file.read_text()
    assert text.startswith("#:schema study.schema.json\n")
    assert json.loads((tmp_path / "study.schema.json").read_text())["title"] == "Calibray study"
    # Never overwritten.
    status, _, err = typed(*words, "-o", file)
    assert (status, "already exists" in err, file.read_text()) == (2, True, text)


@pytest.mark.parametrize(
    ("column", "offsets", "reason"),
    [
        ("Gerät", "Zelle, Gerät", "each transmitter and each receiver has its own gain"),
        ("Straße", "Zelle", "no column of receiving devices was found; each transmitter has its own gain"),
    ],
)
def test_the_reason_of_the_offsets_says_which_columns_were_found(scene, tmp_path, column, offsets, reason):
    places = {"x": [5.0, 9.0, 5.0, 9.0], "y": 15.0, "RSRP [dBm]": [-90.1, -91.2, -92.3, -93.4]}
    file = table(tmp_path, **places, Zelle=["a", "a", "b", "b"], **{column: ["S21", "Pixel", "S21", "Pixel"]})
    cells = tmp_path / "cells.csv"
    pd.DataFrame({"Zelle": ["a", "b"], "x": [0.0, 10.0], "y": 20.0, "z": 10.0}).to_csv(cells, index=False)
    found = draft(scene, file, tmp_path / "study.toml", cells, 3.5e9)
    (offset,) = (each for each in found.assumptions if each.what == "offset.per")
    assert (offset.value, offset.reason) == (offsets, reason)


def test_values_that_the_receiver_clips_become_its_noise_floor(scene, tmp_path):
    """A third of the powers of a walk are below the floor of the receiver; rounded powers without a floor have none."""
    distance = np.geomspace(5.0, 300.0, 300)
    power = -60 - 30 * np.log10(distance) + np.random.default_rng(5).normal(0.0, 6.0, 300)
    floor = np.quantile(power, 0.33).round(1)
    for rsrp, expected in ((np.maximum(power.round(1), floor), floor), (power.round(), None)):
        file = table(tmp_path, x=distance - 150, y=-15.0, z=1.5, rsrp_dbm=rsrp)
        found = draft(scene, file, tmp_path / "study.toml", frequency=3.5e9, tx=[-160.0, -15.0, 10.0])
        assert found.study.links.noise_floor_dbm == expected
        below = int((rsrp == floor).sum()) if expected else 0
        assert found.study.measurements().prepared.get("at or below the noise floor, left out", 0) == below
        reasons = {each.what: each.reason for each in found.assumptions}
        stated = f"{100 * below / 300:.0f} % of the values equal the lowest value" if expected else None
        assert reasons.get("links.noise_floor_dbm") == stated


def test_the_noise_floor_is_that_of_the_least_sensitive_receiver(scene, tmp_path):
    """Receiver B states nothing below -80 dBm, A nothing below -100 dBm; C states everything, but was near."""
    power = np.linspace(-105.0, -60.0, 60)
    received = [np.where(power > -100, power, np.nan), np.where(power > -80, power, np.nan), power / 2]
    rows = {"x": np.tile(np.linspace(-40, 10, 60), 3), "y": 20.0, "rsrp_dbm": np.concatenate(received)}
    file = table(tmp_path, **rows, receiver=np.repeat(["A", "B", "C"], 60))
    found = draft(scene, file, tmp_path / "study.toml", frequency=3.5e9, tx=[-30.0, 0.0, 9.0])
    assert found.study.links.noise_floor_dbm == np.floor(power[power > -80].min())
    assert any(
        "no value of receiver B, the least sensitive device, is lower" in each.reason
        for each in found.assumptions
    )


def test_receivers_with_numbers_are_devices_and_the_directions_of_their_antennas_are_none(scene, tmp_path):
    power = np.linspace(-105.0, -60.0, 60)
    rows = {"x": np.tile(np.linspace(-40, 10, 60), 2), "y": 20.0, "rx_azimuth_deg": np.tile([0.0, 90.0], 60)}
    rows |= {"rsrp_dbm": np.concatenate([np.where(power > -90, power, np.nan), power])}
    file = table(tmp_path, **rows, rx_id=np.repeat([1, 2], 60))
    found = draft(scene, file, tmp_path / "study.toml", frequency=60e9, tx=[-30.0, 0.0, 9.0])
    assert found.study.offset.per == ("rx_id",)
    reasons = {each.what: each.reason for each in found.assumptions}
    assert reasons["links.noise_floor_dbm"].endswith(
        "no value of rx_id 1, the least sensitive device, is lower"
    )
    assert reasons["links.rx_antenna.azimuth_deg"].startswith("column rx_azimuth_deg may describe")


def test_the_noise_floor_is_that_of_the_least_sensitive_receiver_that_states_it(scene, tmp_path):
    """Each receiver writes its own floor for what it does not receive."""
    power = np.random.default_rng(4).uniform(-110.0, -60.0, 180).round(1)
    floor = np.repeat([-92.0, -80.0, -85.0], 60)
    rows = {"x": np.tile(np.linspace(-40, 10, 60), 3), "y": 20.0, "rsrp_dbm": np.maximum(power, floor)}
    file = table(tmp_path, **rows, receiver=np.repeat(["A", "B", "C"], 60))
    found = draft(scene, file, tmp_path / "study.toml", frequency=3.5e9, tx=[-30.0, 0.0, 9.0])
    assert found.study.links.noise_floor_dbm == -80.0
    assert any(
        "of receiver B, the least sensitive device, equal its lowest value" in each.reason
        for each in found.assumptions
    )
    # The received powers of all receivers are above it, and none of them is a floor.
    assert sorted(-found.study.measurements().path_loss_db) == sorted(power[power > -80.0])


def test_values_at_the_ends_of_what_a_receiver_states_are_no_measurements(tmp_path, scene):
    """Each access point of a wide table has a third of its values at either end."""
    power = np.random.default_rng(7).normal(-75.0, 15.0, (200, 2)).round(1).clip(-82.0, -68.0)
    file = table(tmp_path, x=np.arange(200.0), y=-15.0, rss_a=power[:, 0], rss_b=power[:, 1])
    (tmp_path / "masts.csv").write_text("name,x,y,z\na,-20,0,9\nb,-60,0,9\n")
    drafted = draft(scene, file, tmp_path / "study.toml", tmp_path / "masts.csv", 3.5e9)
    losses = drafted.study.measurements().path_loss_db
    assert sorted(losses) == sorted(-power[(power > -82.0) & (power < -68.0)])
    reasons = {assumption.what: assumption.reason for assumption in drafted.assumptions}
    share = f"{100 * (power == -68.0).mean():.0f} %"
    assert (
        reasons["links.where"] == f"{share} of the values equal the highest value: the receiver is saturated"
    )


def test_saturated_values_in_single_precision_are_no_measurements(tmp_path, scene):
    """-43.9 in single precision is -43.900002, which a filter must not round up."""
    power = np.random.default_rng(7).normal(-55.0, 15.0, 200).round(1).clip(None, -43.9)
    power = np.float32(power).astype(float).round(6)
    file = table(tmp_path, x=np.linspace(-40, 40, 200), y=-15.0, rsrp_dbm=power)
    found = draft(scene, file, tmp_path / "study.toml", frequency=3.5e9, tx=[-30.0, 0.0, 9.0])
    assert sorted(-found.study.measurements().path_loss_db) == sorted(power[power < power.max()])


@pytest.mark.parametrize("step", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("count", [20, 300, 5000])
def test_rounded_powers_are_not_taken_for_clipped_ones(step, count):
    random = np.random.default_rng(count)
    for powers in (
        random.normal(-95, 8, count),
        random.uniform(-120, -60, count),
        -70 - random.gamma(2, 8, count),
    ):
        assert _share_at_lowest(pd.Series((powers / step).round() * step)) == 0.0


def test_metres_and_a_distance_tell_where_the_transmitter_stands(scene, tmp_path):
    rx = np.array([(x, y, 1.6) for x in range(-40, 16, 8) for y in (-20.0, 15.0)])
    far = np.sqrt(((rx - [0, 0, 12.0]) ** 2).sum(axis=1))
    file = table(tmp_path, rx_x_m=rx[:, 0], rx_y_m=rx[:, 1], rx_h_m=rx[:, 2], tx_h_m=12.0, dist_m=far, freq_mhz=3500.0,
                 pl_db=100.0, rx_lat=50.0, rx_lon=9.9, pl_std_db=1.0)  # fmt: skip
    found = draft(scene, file, tmp_path / "study.toml")
    assert found.study.links.tx == (0.0, 0.0, 12.0)
    assert found.study.links.rx == ("rx_x_m", "rx_y_m", "rx_h_m")
    assert (found.study.links.value, found.study.scene.frequency) == ("pl_db", 3.5e9)
    # A distance that says otherwise: nothing is assumed.
    file = table(
        tmp_path, rx_x_m=rx[:, 0], rx_y_m=rx[:, 1], tx_h_m=12.0, dist_m=far + 3, freq_mhz=3500.0, pl_db=100.0
    )
    with pytest.raises(InputError, match="--tx X,Y,Z"):
        draft(scene, file, tmp_path / "study.toml")
    given = draft(scene, file, tmp_path / "study.toml", tx=[1.0, 2.0, 3.0])
    assert given.study.links.tx == (1.0, 2.0, 3.0)


def test_trees_next_to_the_scene_become_a_region(scene, tmp_path):
    rows = {
        "rx_x": [-30.0, -20.0, 5.0],
        "rx_y": [0.0, 30.0, 20.0],
        "rx_z": 1.5,
        "path_loss_db": [70.0, 80.0, 75.0],
    }
    given = {"tx": [10.0, 0.0, 6.0], "frequency": 3.5e9}
    ring = shapely.transform(
        shapely.box(-5, -3, 0, 3), lambda xy: FRAME.to_geographic(np.c_[xy, 0 * xy[:, 0]])[:, :2]
    )
    feature = {"type": "Feature", "properties": {"kind": "wood", "bottom": 0.0, "top": 9.0}}
    feature["geometry"] = json.loads(shapely.to_geojson(ring))
    trees = {"type": "FeatureCollection", "features": [feature]}
    (Path(scene).parent / "trees.geojson").write_text(json.dumps(trees))
    found = draft(scene, table(tmp_path, **rows), tmp_path / "study.toml", **given)
    section = found.study.regions["trees"]
    assert (section.file, section.heights, section.top) == ("town/trees.geojson", "ground", "top")
    assert section.specific_attenuation == pytest.approx(0.45 * 3.5**0.284, abs=0.005)
    assert "region:trees.specific_attenuation" in found.study.parameters
    assert any("the straight lines of 1 of 3 links cross trees" in each.reason for each in found.assumptions)
    assert found.study.regions["trees"].file in found.text
    # Without trees on the straight line of a link, their attenuation is no parameter.
    elsewhere = draft(
        scene, table(tmp_path, **rows), tmp_path / "study.toml", **given | {"tx": [-40.0, 20.0, 6.0]}
    )
    assert list(elsewhere.study.regions) == ["trees"]
    assert "region:trees.specific_attenuation" not in elsewhere.study.parameters
    (Path(scene).parent / "trees.geojson").unlink()
    assert not draft(scene, table(tmp_path, **rows), tmp_path / "study.toml", **given).study.regions


def test_a_column_named_with_any_character_makes_a_study_that_reads(scene, tmp_path):
    """TOML forbids DEL in texts, JSON allows it."""
    columns = {"rx_x_m\x7f": [5.0, 9.0], "rx_y_m": [1.0, 2.0], "rx_z_m": 1.5, "path_loss_db": [70.0, 80.0]}
    file = table(tmp_path, **columns)
    text = study_text({"version": 1, "links": {"rx": list(columns), "x\x7f": 1}}, {})
    assert tomllib.loads(text)["links"] == {"rx": list(columns), "x\x7f": 1}
    drafted = draft(scene, file, tmp_path / "study.toml", tx=[0.0, 0.0, 12.0], frequency=3.5e9)
    assert drafted.study.links.rx[0] == "rx_x_m\x7f"


@pytest.mark.parametrize(("column", "height"), [("alt", 1.5), ("height", "height")])
def test_a_column_of_altitudes_that_is_not_used_is_named(scene, tmp_path, column, height):
    """A drone at 30 to 120 m, whose altitude may count from the ground or from sea level, is not silently a phone."""
    lon, lat, _ = FRAME.to_geographic([(-20.0, -25.0 + 4 * row, 0.0) for row in range(12)]).T
    up = np.linspace(30, 120, 12)
    file = table(tmp_path, mast="a", lon=lon, lat=lat, **{column: up}, rssi_dbm=-60.0 - np.arange(12.0))
    (tmp_path / "masts.csv").write_text("mast,lon,lat,height\na,9.9897,50.0101,9\n")
    found = draft(scene, file, tmp_path / "study.toml", tmp_path / "masts.csv", 2.4e9)
    (reason,) = [each.reason for each in found.assumptions if each.what == "links.rx"]
    assert found.study.links.rx == ("lon", "lat", height)
    assert ("alt is ignored, because altitudes may be above sea level" in reason) == (column == "alt")


@pytest.mark.parametrize(("places", "height"), [(12, 1.5), (2, 10.0)])
def test_transmitters_that_move_are_as_low_as_receivers(scene, tmp_path, places, height):
    """Vehicle to vehicle: both positions change from row to row. Those of two masts repeat."""
    tx = np.array([(-30.0 + 2 * (row % places), -30.0, 0.0) for row in range(12)])
    rx = np.array([(-20.0, -25.0 + 4 * row, 0.0) for row in range(12)])
    (tx_lon, tx_lat, _), (rx_lon, rx_lat, _) = FRAME.to_geographic(tx).T, FRAME.to_geographic(rx).T
    file = table(
        tmp_path, tx_lon=tx_lon, tx_lat=tx_lat, rx_lon=rx_lon, rx_lat=rx_lat, rssi_dbm=-60.0 - tx[:, 0]
    )
    found = draft(scene, file, tmp_path / "study.toml", frequency=5.9e9)
    assert found.study.links.tx == ("tx_lon", "tx_lat", height)
    assert found.study.links.rx == ("rx_lon", "rx_lat", 1.5)


def test_a_wide_table_indoors(tmp_path):
    plan = tmp_path / "plan.csv"
    plan.write_text(
        "x0,y0,x1,y1,type\n0,0,12,0,brick\n12,0,12,8,brick\n12,8,0,8,brick\n0,8,0,0,brick\n6,0,6,8,plasterboard\n"
    )
    scene = make_plan_scene(read_plan(plan), tmp_path / "flat", {})
    (tmp_path / "aps.csv").write_text("name,x,y,z\nap1,1,1,2.5\nap2,11,7,2.5\n")
    file = table(tmp_path, x=[2.0, 4.0, 8.0], y=[3.0, 4.0, 5.0], rss_ap1=[-40.0, -45.0, -60.0],
                 rss_ap2=[-65.0, np.nan, -45.0])  # fmt: skip
    found = draft(str(scene.path), file, tmp_path / "study.toml", tmp_path / "aps.csv", 2.4e9)
    links = found.study.measurements()
    assert len(links) == 5
    assert links.group_names == ("ap1", "ap2")
    assert links.tx[0].tolist() == [1.0, 1.0, 2.5]
    assert found.study.trace.refraction
    # The line from ap1 to (8, 5) crosses one wall; no fewer than three interactions.
    assert found.study.trace.max_depth == 3
    assert assumed(found)["trace"] == "through walls"
    assert "brick_wall.conductivity" in found.study.parameters


def test_a_wide_table_of_cells_whose_table_names_their_sites_too(scene, tmp_path):
    """Scanners name the columns of a drive test by the physical cell identity (PCI)."""
    file = table(
        tmp_path, x=[2.0, -4.0], y=-15.0, **{"PCI 101 RSRP [dBm]": -80.0, "PCI 102 RSRP [dBm]": -85.0}
    )
    (tmp_path / "cells.csv").write_text("Site,PCI,x,y,z\nnorth,101,-20,0,9\nwest,102,-60,0,9\n")
    found = draft(scene, file, tmp_path / "study.toml", tmp_path / "cells.csv", 1.8e9)
    assert found.study.links.wide == {"PCI 101 RSRP [dBm]": "101", "PCI 102 RSRP [dBm]": "102"}
    assert found.study.measurements().group_names == ("101", "102")


def test_a_value_below_a_limit_is_refused_with_the_key_that_states_the_limit(scene, tmp_path):
    file = table(tmp_path, x=[2.0, -4.0], y=-15.0, rsrp_a=["-80", "<-95"], rsrp_b=["-85", "-90"])
    (tmp_path / "masts.csv").write_text("name,x,y,z\na,-20,0,9\nb,-60,0,9\n")
    with pytest.raises(
        InputError,
        match="row 3, column 'rsrp_a': '<-95' is not a number; write the limit without this sign, and",
    ):
        draft(scene, file, tmp_path / "study.toml", tmp_path / "masts.csv", 3.5e9)


def test_a_track_and_a_hill(tmp_path):
    """A house on a slope of 1 in 10, a walk of 40 m past it: each row at its time, each antenna above its ground."""
    rows, columns = np.mgrid[0:2, 0:2]
    terrain = Terrain(
        np.array([-50.0, 50.0]), np.array([-50.0, 50.0]), 5.0 + 0.1 * (100.0 * columns + 0.0 * rows)
    )
    box = np.array([shapely.box(20, -10, 40, 10)])
    house = Footprints(box, np.zeros(1), np.full(1, 9.0), ("house",), ("height",), np.zeros(1, bool), {})
    scene = str(make_scene(house, tmp_path / "hill", FRAME, terrain).path)
    east = FRAME.to_geographic([(-20.0, 20.0, 0.0), (20.0, 20.0, 0.0), (0.0, -30.0, 0.0)])
    points = "".join(
        f'<trkpt lat="{east[k][1]:.8f}" lon="{east[k][0]:.8f}"><time>2026-05-04T09:00:{8 * k:02d}Z</time></trkpt>'
        for k in range(2)
    )
    (tmp_path / "walk.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    clock = [f"2026-05-04T09:00:{second:02d}Z" for second in (0, 2, 4, 6, 8, 30)]
    file = table(tmp_path, time=clock, mast="a", rsrp_dbm=np.linspace(-80.0, -90.0, 6))
    sites = tmp_path / "sites.csv"
    sites.write_text(f"mast,longitude,latitude,height\na,{east[2][0]:.8f},{east[2][1]:.8f},12\n")
    found = draft(scene, file, tmp_path / "study.toml", sites, 3.5e9, track=tmp_path / "walk.gpx")
    links = found.study.measurements()
    assert links.rx[:, 0] == pytest.approx([-20, -10, 0, 10, 20], abs=0.01)
    assert links.rx[:, 2] == pytest.approx(5.0 + 0.1 * (links.rx[:, 0] + 50) + 1.5, abs=0.01)
    assert links.tx[0] == pytest.approx([0, -30, 22.0], abs=0.01)
    assert links.prepared == {"rows without a position on the track, left out": 1, "samples averaged": 5}
    assert found.study.files()[2:4] == (tmp_path / "sites.csv", tmp_path / "walk.gpx")
    assert assumed(found)["links.heights"] == "ground"
    assert assumed(found)["links.track"] == "walk.gpx by time"
    with pytest.raises(InputError, match="no column of times"):
        draft(scene, table(tmp_path, rsrp_dbm=[-80.0]), tmp_path / "study.toml", sites, 3.5e9,
              track=tmp_path / "walk.gpx")  # fmt: skip
    # Outside the scene there is no ground to count from.
    far = links.frame.assign(time=clock[:5])
    with pytest.raises(InputError, match=r"no ground at 5 of 5 positions"):
        SceneSurfaces.read(scene).ground_height(far["rx_x"] + 500.0, far["rx_y"])


@pytest.mark.parametrize(
    ("column", "values", "kind"),
    [
        ("pl_total_db", 110.0, "path_loss"),
        ("path_gain_db", -80.0, "path_gain"),
        ("path_loss_db", -80.0, "path_gain"),
        ("RSRP [dBm]", -95.0, "rsrp"),
        ("rssi", -70.0, "rsrp"),
    ],
)
def test_quantities_are_told_by_name_and_sign(column, values, kind):
    links = SourceTable(pd.DataFrame({column: [values] * 3, "sample_std_db": 3.0, "rx_level": 8}))
    found = column_names.find_value(links)
    assert (found.column, found.quantity) == (column, kind)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x": [1.0], "y": [2.0], "temperature": [20.0]}, "no column appears to contain path loss"),
        ({"a": [1.0], "pl_db": [90.0]}, "no columns of receiver positions"),
        ({"x": [1.0], "y": [2.0], "pl_db": [90.0]}, "--tx X,Y,Z"),
        ({"lon": [9.99], "lat": [50.01], "tx_x": [0.0], "tx_y": [0.0], "pl_db": [90.0]}, "different units"),
    ],
)
def test_what_cannot_be_told_is_asked_for(scene, tmp_path, columns, message):
    with pytest.raises(InputError, match=message):
        draft(scene, table(tmp_path, **columns), tmp_path / "study.toml", frequency=3.5e9)
    with pytest.raises(InputError, match="give --frequency"):
        draft(scene, table(tmp_path, **columns), tmp_path / "study.toml")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            {"Lat": "50.01N", "Lon": 9.99, "RSRP": -80.0},
            "'Lat' contains text such as '50.01N'; write numbers",
        ),
        ({"lat": 5000.6, "lon": 959.4, "RSRP": -80.0}, "'lat' has values of about 5001, not degrees"),
        ({"x": 0.0, "y": 30.0, "RSRP": ["<-110"] + ["-80"] * 9}, "'RSRP' contains text such as '<-110'"),
        (
            {"x": 0.0, "y": 30.0, "Signal": 84.0},
            "'Signal' has values of about 84, but received powers .* negative",
        ),
    ],
)
def test_a_refusal_says_what_is_wrong_with_a_column_that_was_meant(scene, tmp_path, columns, message):
    file = table(tmp_path, tx_x=np.full(10, -30.0), tx_y=0.0, **columns)
    with pytest.raises(InputError, match=message):
        draft(scene, file, tmp_path / "study.toml", frequency=3.5e9)


def test_the_schema_is_that_of_the_model():
    status, out, _ = typed("schema")
    assert (status, out) == (0, schema_text())
    committed = (REPOSITORY / "docs" / "reference" / "study.schema.json").read_text(encoding="utf-8")
    assert committed == out, "run: calibray schema > docs/reference/study.schema.json"
    content = json.loads(out)
    assert content["additionalProperties"] is False
    assert set(content["required"]) == {"version", "scene", "links", "parameters"}


def test_codes_of_missing_values_and_unknown_transmitters_are_reported(scene, tmp_path):
    (tmp_path / "sites.csv").write_text("cell,x,y,z\nA,-30,0,15\nB,60,0,15\n")
    file = table(
        tmp_path,
        x=np.arange(10.0),
        y=20.0,
        cell=list("AABBAABBCD"),
        rssi=[-70, -71, 100, -80, -75, 100, *[-77] * 4],
    )
    drafted = draft(scene, file, tmp_path / "study.toml", tmp_path / "sites.csv", 3.5e9)
    reasons = {assumption.what: assumption.reason for assumption in drafted.assumptions}
    assert reasons["links.where"] == "sites.csv lacks C, D: 2 rows are left out"
    assert reasons["links.missing"] == "far from all other values of rssi and therefore treated as missing"
    assert drafted.study.links.missing == (100.0,)
    assert drafted.study.links.noise_floor_dbm == -80.0
    links = drafted.study.measurements()
    assert links.prepared["codes for missing values (100)"] == 2
    assert links.path_loss_db.max() < 80.0


def test_rows_without_a_receiver_position_are_left_out_and_counted(scene, tmp_path):
    """A logger also writes powers while its satellite receiver has no position."""
    (tmp_path / "sites.csv").write_text("cell,x,y,z\nA,-30,0,15\nB,60,0,15\n")
    east, north = np.arange(10.0), np.full(10, 20.0)
    east[:2], north[1:3] = np.nan, np.nan
    file = table(tmp_path, x=east, y=north, cell=list("AABBAABBAA"), rssi=np.arange(-90.0, -80.0))
    drafted = draft(scene, file, tmp_path / "study.toml", tmp_path / "sites.csv", 3.5e9)
    reasons = {assumption.what: assumption.reason for assumption in drafted.assumptions}
    assert reasons["links.where"] == "no receiver position: 3 rows are left out"
    assert assumed(drafted)["links.where"] == "`x`.notna() and `y`.notna()"
    assert drafted.study.measurements().rx[:, 0].tolist() == [*range(3, 10)]


def test_unknown_transmitters_are_named_on_stderr_and_in_one_assumption(scene, tmp_path, caplog):
    (tmp_path / "sites.csv").write_text("cell,x,y,z\nA,-30,0,15\nB,60,0,15\n")
    east = np.arange(10.0)
    east[0] = np.nan
    file = table(tmp_path, x=east, y=20.0, cell=list("AABBAABCCD"), rssi=np.arange(-90.0, -80.0))
    drafted = draft(scene, file, tmp_path / "study.toml", tmp_path / "sites.csv", 3.5e9)
    assert "sites.csv lacks C (2 rows), D (1 row); these rows are left out" in caplog.text
    filters = [each for each in drafted.assumptions if each.what == "links.where"]
    assert [each.value for each in filters] == ["`cell` in ['A', 'B'] and `x`.notna()"]
    assert filters[0].reason == (
        "sites.csv lacks C, D: 3 rows are left out; no receiver position: 1 row is left out"
    )
    assert len(drafted.study.measurements()) == 6


def test_a_repeated_transmitter_is_named_unless_its_rows_are_equal(scene, tmp_path):
    sites, study = tmp_path / "sites.csv", tmp_path / "study.toml"
    file = table(tmp_path, x=np.arange(10.0), y=20.0, cell=list("AB" * 5), rssi=np.arange(-90.0, -80.0))
    sites.write_text("cell,x,y,z\nA,-30,0,15\nB,60,0,15\nB,60,0,15\n")
    drafted = draft(scene, file, study, sites, 3.5e9)
    assert np.unique(drafted.study.measurements().tx[:, 0]).tolist() == [-30.0, 60.0]
    sites.write_text("cell,x,y,z\nA,-30,0,15\nB,60,0,15\nB,70,0,15\n")
    with pytest.raises(InputError, match=r"sites.csv: 'B' appears in rows 3, 4 of column 'cell'; give each"):
        draft(scene, file, study, sites, 3.5e9)


def test_faults_of_the_table_of_transmitters_are_named(scene, tmp_path):
    sites, study = tmp_path / "sites.csv", tmp_path / "study.toml"
    file = table(tmp_path, x=np.arange(10.0), y=20.0, cell=list("AB" * 5), rssi=np.arange(-90.0, -80.0))
    sites.write_text("cell,x,y,z,Frequency (Hz)\nA,-30,0,15,1842.5\nB,60,0,15,1842.5\n")
    with pytest.raises(
        InputError, match=r"sites.csv: column 'Frequency \(Hz\)' has values of about 1842.5; it must"
    ):
        draft(scene, file, study, sites)
    sites.write_text('cell,x,y,z\nA,"-30,0",0,15\nB,"60,5",0,15\n')
    with pytest.raises(
        InputError, match=r"sites.csv: no columns of positions.*contains text such as '-30,0'"
    ):
        draft(scene, file, study, sites, 3.5e9)
    sites.write_text("cell,x,y,Height AMSL (m)\nA,-30,0,55\nB,60,0,55\n")
    drafted = draft(scene, file, study, sites, 3.5e9)
    reasons = {each.what: each.reason for each in drafted.assumptions}
    assert "Height AMSL (m) is ignored, because altitudes may be above sea level" in reasons["links.tx"]


def test_transmitters_are_found_by_their_names_whatever_the_column_is_called(scene, tmp_path):
    (tmp_path / "gateways.csv").write_text("id,x,y,z,floor\nA,-30,0,15,1\nB,60,0,15,2\n")
    file = table(tmp_path, x=np.arange(10.0), y=20.0, gatewayId=list("AABBAABBAC"), rssi=np.arange(-80, -70))
    drafted = draft(scene, file, tmp_path / "study.toml", tmp_path / "gateways.csv", 3.5e9)
    reasons = {assumption.what: assumption.reason for assumption in drafted.assumptions}
    assert reasons["links.transmitter"] == "the values also occur in column id of gateways.csv"
    assert reasons["links.where"] == "gateways.csv lacks C: 1 row is left out"
    assert drafted.study.offset.per == ("gatewayId",)
    links = drafted.study.measurements()
    assert links.tx[:, 0].tolist() == [-30, -30, 60, 60, -30, -30, 60, 60, -30]
    # A column of numbers that happen to agree names nothing.
    other = table(tmp_path, x=np.arange(10.0), y=20.0, layer=[1, 2] * 5, rssi=np.arange(-80, -70))
    with pytest.raises(InputError, match="no column names the transmitters of the rows"):
        draft(scene, other, tmp_path / "study.toml", tmp_path / "gateways.csv", 3.5e9)


def test_names_of_transmitters_are_compared_as_tools_write_them(scene, tmp_path):
    """Addresses in lower case, whole numbers as floats since a row has none; `run` finds them as `init` does."""
    (tmp_path / "beacons.csv").write_text(
        "name,mac,number,x,y,z\nb1,C4-64-E3,7,-30,0,15\nb2,C4-64-E4,9,60,0,15\n"
    )
    for column, labels in (("address", ["c4:64:e3", "c4:64:e4"]), ("Cell ID", [7.0, 9.0])):
        rows = {"x": np.arange(10.0), "y": 20.0, column: labels * 5, "rssi": np.arange(-80, -70)}
        file = table(tmp_path, **rows)
        if column == "Cell ID":
            file.write_text(file.read_text() + "3.0,25.0,,-70\n")
        drafted = draft(scene, file, tmp_path / "study.toml", tmp_path / "beacons.csv", 3.5e9)
        assert drafted.study.links.transmitter == column
        assert drafted.study.measurements().tx[:, 0].tolist() == [-30, 60] * 5
    # Names that differ in case alone stay apart.
    (tmp_path / "beacons.csv").write_text("name,x,y,z\na,-30,0,15\nA,60,0,15\n")
    file = table(tmp_path, x=np.arange(10.0), y=20.0, name=["a", "A"] * 5, rssi=np.arange(-80, -70))
    drafted = draft(scene, file, tmp_path / "study.toml", tmp_path / "beacons.csv", 3.5e9)
    assert drafted.study.measurements().tx[:, 0].tolist() == [-30, 60] * 5


def test_positions_in_centimetres_are_read_as_such(scene, tmp_path):
    rows = {
        "X [cm]": 100 * np.arange(10.0),
        "Y [cm]": 2000.0,
        "H\u00f6he [cm]": 150,
        "Pegel [dBm]": np.arange(-80, -70),
    }
    drafted = draft(
        scene, table(tmp_path, **rows), tmp_path / "study.toml", frequency=3.5e9, tx=(-30.0, 0.0, 15.0)
    )
    assert assumed(drafted)["links.position_unit"] == "0.01 m"
    links = drafted.study.measurements()
    np.testing.assert_allclose(links.rx[3], [3.0, 20.0, 1.5])
    assert links.tx[0].tolist() == [-30, 0, 15]


def test_heights_in_another_unit_do_not_scale_the_other_columns(scene, tmp_path):
    rows = {"x": np.arange(10.0), "y": 20.0, "height_ft": 5.0, "rsrp_dbm": np.arange(-80, -70)}
    with pytest.raises(InputError, match=r"state a unit of 0.3048 m, with the exception of x, y"):
        draft(scene, table(tmp_path, **rows), tmp_path / "study.toml", frequency=3.5e9, tx=(-30.0, 0.0, 15.0))


def test_degrees_in_columns_named_x_and_y_are_degrees(scene, tmp_path):
    """As metres, all links would be within millimetres of (9.99, 50.01) m."""
    metres = np.array([[-20.0, 15.0], [-5.0, -15.0], [5.0, 18.0]])
    x, y, _ = FRAME.to_geographic(np.column_stack([metres, np.zeros(3)])).T
    links = table(tmp_path, x=x, y=y, tx_x=9.99, tx_y=50.01, rssi=[-50.0, -60.0, -70.0])
    drafted = draft(scene, links, tmp_path / "study.toml", frequency=3.5e9)
    assert assumed(drafted)["links.position"] == "geographic"
    np.testing.assert_allclose(drafted.study.measurements().rx[:, :2], metres, atol=1e-3)
    np.testing.assert_allclose(drafted.study.measurements().tx[:, :2], 0.0, atol=1e-3)


def test_a_row_that_lacks_one_coordinate_does_not_hinder_placing_the_others(scene, tmp_path):
    rows = {"x": np.arange(10.0), "y": 20.0, "tx_x": -30.0, "tx_y": 0.0, "rssi": np.arange(-60.0, -50.0)}
    rows["x"][3] = np.nan
    drafted = draft(scene, table(tmp_path, **rows), tmp_path / "study.toml", frequency=3.5e9)
    assert drafted.study.measurements().rx[:, 0].tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9]


def test_the_origin_of_a_scene_without_a_frame_places_degrees(scene, tmp_path):
    """The radii of curvature of WGS 84 give the metres of a degree; without `--origin`, degrees have no place."""
    file = Path(scene)
    file.write_text("\n".join(line for line in file.read_text().splitlines() if "calibray frame" not in line))
    longitude, latitude, squared = 9.99, 50.01, 0.00669437999014
    curvature = 1 - squared * np.sin(np.radians(latitude)) ** 2
    north = np.radians(1e-4) * 6378137.0 * (1 - squared) / curvature**1.5 * np.array([1, -2, 3])
    east = (
        np.radians(1e-4) * 6378137.0 * np.cos(np.radians(latitude)) / curvature**0.5 * np.array([-1, -2, -3])
    )
    degrees = {
        "longitude": longitude - 1e-4 * np.array([1, 2, 3]),
        "latitude": latitude + 1e-4 * np.array([1, -2, 3]),
    }
    links = table(
        tmp_path, **degrees, tx_longitude=longitude, tx_latitude=latitude, rssi=[-50.0, -60.0, -70.0]
    )
    target = tmp_path / "study.toml"
    with pytest.raises(InputError, match="--origin LON,LAT"):
        draft(scene, links, target, frequency=3.5e9)
    # A file of this name next to a scene of another program need not be one that `calibray scene` wrote.
    (file.parent / "trees.geojson").write_text("{}")
    code, shown, errors = typed(
        *("init", scene, links, "--frequency", 3.5e9, "--origin", f"{longitude},{latitude}", "--out", target)
    )
    assert code == 0, errors
    assert "--origin states the georeference of the scene" in " ".join(shown.split())
    placed = Study.load(target).measurements()
    np.testing.assert_allclose(placed.rx[:, :2], np.stack([east, north], axis=1), atol=0.02)
    np.testing.assert_allclose(placed.tx[:, :2], 0.0, atol=0.02)
    code, _, errors = typed(
        "init", scene, links, "--frequency", 3.5e9, "--origin", "9.99", "--out", "other.toml"
    )
    assert code == 2
    assert "--origin 9.99: must be longitude and latitude in degrees" in " ".join(errors.split())
    for option, value in (
        ("--origin", "nan,48"),
        ("--origin", "11,91"),
        ("--frequency", 0),
        ("--frequency", "nan"),
    ):
        given = {"--frequency": 3.5e9, "--origin": "9.99,50", option: value}
        words = (word for pair in given.items() for word in pair)
        status, _, errors = typed("init", scene, links, *words, "--out", "other.toml")
        assert status == 2
        assert errors.startswith(f"Error: {option}"), errors


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:3857", "EPSG:31467"])
def test_metres_of_a_map_projection_are_placed_on_the_scene(scene, tmp_path, crs):
    """UTM, Web Mercator, and Gauss-Krueger of another datum, some 100 m off if taken for a UTM zone's."""
    east, north = np.meshgrid(np.linspace(-20.0, 15.0, 6), np.linspace(-40.0, 40.0, 5))
    degrees = FRAME.to_geographic(np.stack([east.ravel(), north.ravel(), np.full(30, 1.5)], axis=1))
    x, y = transformer("EPSG:4326", crs).transform(*degrees.T[:2])
    site = transformer("EPSG:4326", crs).transform(*FRAME.to_geographic([[60.0, 30.0, 9.0]])[0, :2])
    (tmp_path / "sites.csv").write_text(f"cell,Rechtswert,Hochwert,height\nA,{site[0]},{site[1]},9\n")
    file = table(tmp_path, Rechtswert=x, Hochwert=y, cell="A", rssi=-50.0 - np.arange(30))
    drafted = draft(scene, file, tmp_path / "study.toml", tmp_path / "sites.csv", 3.5e9)
    links = drafted.study.measurements()
    np.testing.assert_allclose(links.rx[:, :2], np.stack([east.ravel(), north.ravel()], axis=1), atol=1.5)
    np.testing.assert_allclose(links.tx[0], [60.0, 30.0, 9.0], atol=1.5)
    (tmp_path / "far.csv").write_text(
        "x,y,tx_x,tx_y,pathloss\n" + "\n".join(f"{9e6 + k},5,9e6,0,9{k}" for k in range(9))
    )
    assert draft(scene, tmp_path / "far.csv", tmp_path / "study.toml", frequency=3e9).study.links.crs is None


def test_round_trip_times_become_an_observable_with_a_bias_per_access_point(scene, tmp_path):
    columns = {
        "ap": ["a", "a", "b", "b"], "ap_x": [0.0, 0, 5, 5], "ap_y": 0.0, "ap_z": 2.5, "rx_x": [3.0, 4, 5, 6],
        "rx_y": -12.0, "rx_z": 1.5, "rssi_dbm": [-50.0, -52, -54, -60], "rtt_std_ns": 2.0, "rtt_ns": [40.0, 50, 60, 70],
    }  # fmt: skip
    found = draft(scene, table(tmp_path, **columns), tmp_path / "study.toml", frequency=5.5e9)
    section = found.study.observables["flight"]
    assert (section.kind, section.column, section.unit) == ("round_trip_time", "rtt_ns", "ns")
    assert (section.bias, section.path) == ("ap", "first")
    assert "observables.flight" in assumed(found)
    scans = {name: values * 3 if isinstance(values, list) else values for name, values in columns.items()}
    found = draft(scene, table(tmp_path, **scans), tmp_path / "study.toml", frequency=5.5e9)
    assert found.study.links.average is not None
    assert found.study.observables["flight"] == section
    metres = columns | {"rtt_ns": None, "ftm_distance_m": [3.0, 4, 5, 6]}
    del metres["rtt_ns"]
    found = draft(scene, table(tmp_path, **metres), tmp_path / "study.toml", frequency=5.5e9)
    section = found.study.observables["flight"]
    assert (section.kind, section.unit) == ("time_of_flight", "m")
    assert section.scale == pytest.approx(1 / 299_792_458)


def test_flight_times_of_several_devices_have_a_bias_per_device(scene, tmp_path):
    columns = {
        "ap": ["a", "a", "b", "b"], "ap_x": [0.0, 0, 5, 5], "ap_y": 0.0, "ap_z": 2.5, "rx_x": [3.0, 4, 5, 6],
        "rx_y": -12.0, "rx_z": 1.5, "path_loss_db": [50.0, 52, 54, 60], "tof_ns": [40.0, 50, 60, 70],
        "geraet": ["Gerät A", "Gerät B"] * 2,
    }  # fmt: skip
    found = draft(scene, table(tmp_path, **columns), tmp_path / "study.toml", frequency=2.4e9)
    assert found.study.observables["flight"].bias == "geraet"
    reasons = {each.what: each.reason for each in found.assumptions}
    assert reasons["observables.flight"] == "by its name; the bias of each device is unknown"


@pytest.mark.parametrize("name", ["ds_ns", "Delay Spread [ns]", "RMS-DelaySpread (ns)"])
def test_a_delay_spread_is_named_with_the_section_that_would_use_it(scene, tmp_path, name):
    columns = {"tx_x": 0.0, "tx_y": 0.0, "tx_z": 2.5, "rx_x": [3.0, 4, 5, 6], "rx_y": -12.0, "rx_z": 1.5}
    file = table(tmp_path, **columns, path_loss_db=[50.0, 52, 54, 60], **{name: [10.0, 12, 14, 9]})
    found = draft(scene, file, tmp_path / "study.toml", frequency=2.4e9)
    assert not found.study.observables
    reason = {each.what: each.reason for each in found.assumptions}["observables.spread"]
    assert reason.startswith(f"column {name} is not used")
    assert f'[observables.spread] with kind = "rms_delay_spread", column = "{name}", unit = "ns"' in reason


def test_transmitters_in_the_links_get_an_offset_each(scene, tmp_path):
    columns = {
        "x": np.arange(10.0),
        "y": 20.0,
        "tx_x": [-30.0, 60.0] * 5,
        "tx_y": 0.0,
        "rsrp": np.arange(-80, -70),
    }
    drafted = draft(
        scene, table(tmp_path, **columns, cell_id=[7, 9] * 5), tmp_path / "study.toml", frequency=3.5e9
    )
    assert (drafted.study.links.transmitter, drafted.study.offset.per) == ("cell_id", ("cell_id",))
    assert len(set(np.asarray(drafted.study.measurements().group))) == 2
    # A cell that appears at two positions does not name a transmitter.
    drafted = draft(scene, table(tmp_path, **columns, cell_id=7), tmp_path / "study.toml", frequency=3.5e9)
    assert not drafted.study.offset.per


def test_a_carrier_that_no_law_of_itu_covers_gets_the_constants_of_the_nearest(scene, tmp_path):
    columns = {"x": np.arange(10.0), "y": 20.0, "tx_x": -30.0, "tx_y": 0.0, "pathloss": np.arange(80, 90)}
    for frequency, covered in ((868.1e6, False), (3.5e9, True)):
        drafted = draft(scene, table(tmp_path, **columns), tmp_path / "study.toml", frequency=frequency)
        assert ("materials" in {assumption.what for assumption in drafted.assumptions}) != covered
        assert (len(drafted.study.materials) == 0) == covered
    at_1_ghz = itu_material("concrete", 1e9)
    stated = draft(
        scene, table(tmp_path, **columns), tmp_path / "study.toml", frequency=868.1e6
    ).study.materials
    assert stated["walls"].conductivity == pytest.approx(at_1_ghz.conductivity)
    assert stated["walls"].relative_permittivity == at_1_ghz.relative_permittivity


def test_carriers_of_the_table_of_transmitters_are_read(scene, tmp_path):
    sites = pd.DataFrame({"cell": ["a", "b", "other"], "x": [-30.0, -60.0, 0.0], "y": 0.0, "height": 9.0})
    rows = {"x": np.arange(10.0), "y": 20.0, "cell": ["a", "b"] * 5, "rsrp_dbm": np.arange(-90, -80)}
    links, target = table(tmp_path, **rows), tmp_path / "study.toml"

    def drafted(frequency=None, **carriers):
        sites.assign(**carriers).to_csv(tmp_path / "cells.csv", index=False)
        return draft(str(scene), links, target, tmp_path / "cells.csv", frequency)

    # Only the transmitters of the links count.
    assert drafted(**{"freq [MHz]": [800.0, 800.0, 2100.0]}).study.scene.frequency == 800e6
    for frequency in (None, 2e9):
        several = drafted(frequency, **{"freq [MHz]": [3500.0, 800.0, 2100.0]})
        assert several.study.scene.frequency == (frequency or 800e6)
        assert several.study.links.frequency == "freq [MHz]"
        assert [carrier for carrier, _ in several.study.measurements().carriers] == [800e6, 3500e6]
    said = {assumption.what: assumption.reason for assumption in several.assumptions}
    assert said["scene.frequency"] == "given; the lowest carrier of column freq [MHz] is 8e+08 Hz"
    with pytest.raises(InputError, match=r"cells\.csv: column 'freq' has 2 carriers.*frequency_mhz"):
        drafted(freq=[3500.0, 800.0, 2100.0])


def test_every_transmitter_has_a_gain_at_each_of_its_carriers(scene, tmp_path):
    """A unit of frequency names carriers, unless the column is a bandwidth; they are never averaged together."""
    sites = tmp_path / "cells.csv"
    sites.write_text("cell,x,y,height\na,-30,0,9\nb,-60,0,9\n")
    rows = {"x": np.repeat(np.arange(10.0), 2), "y": 20.0, "rsrp_dbm": np.arange(-90, -70)}
    several = {**rows, "cell": np.repeat(["a", "b"], 10), "BW [MHz]": [5.0, 10.0] * 10}
    found = draft(
        scene,
        table(tmp_path, **several, **{"Frq [MHz]": [763.0, 1842.5] * 10}),
        tmp_path / "study.toml",
        sites,
    )
    assert found.study.links.frequency == "Frq [MHz]"
    assert [carrier for carrier, _ in found.study.measurements().carriers] == [763e6, 1842.5e6]
    assert assumed(found)["offset.per"] == "cell, Frq [MHz]"
    one_each = {**several, "Frq [MHz]": np.repeat([763.0, 1842.5], 10)}
    found = draft(scene, table(tmp_path, **one_each), tmp_path / "study.toml", sites)
    assert assumed(found)["offset.per"] == "cell"


@pytest.mark.parametrize(("places", "held_out"), [(24, True), (18, False), (24, False)])
def test_blocks_are_held_out_if_links_suffice(scene, tmp_path, places, held_out):
    columns = {
        "x": np.arange(24.0) % places,
        "y": 20.0,
        "pathloss": np.arange(80, 104),
        "tx_x": -30.0,
        "tx_y": 0.0,
    }
    if not held_out and places == 24:  # as many offsets as there are links for five each
        columns = {**columns, "tx_x": -30.0 - np.arange(24.0) // 4, "cell": np.arange(24) // 4}
        columns["rsrp"] = -columns.pop("pathloss")
    drafted = draft(scene, table(tmp_path, **columns), tmp_path / "study.toml", frequency=3.5e9)
    assert (drafted.study.holdout is not None) == held_out
    assert ("holdout.blocks" in assumed(drafted)) == held_out
    assert not held_out or drafted.study.holdout.blocks == 4


def test_an_empty_column_of_frequencies_states_none(scene, tmp_path):
    file = table(tmp_path, rx_x=[5.0, 6.0], rx_y=40.0, path_loss_db=[90.0, 91.0], frequency_mhz=np.nan)
    with pytest.raises(InputError, match="no column of carrier frequencies; give --frequency"):
        draft(scene, file, tmp_path / "study.toml", tx=(0, 0, 40))


@pytest.mark.parametrize("samples", [1, 3, 25])
def test_receivers_above_each_other_are_not_averaged_together(scene, tmp_path, samples):
    """A profile of ten heights from 1.5 to 30 m over each of 20 places, in one or several samples."""
    random = np.random.default_rng(1)
    places = np.column_stack([random.uniform(-40, 10, 20), random.uniform(-40, 40, 20)])
    x, y = np.repeat(places, 10 * samples, axis=0).T
    height = np.tile(np.repeat(np.linspace(1.5, 30, 10), samples), 20)
    loss = random.uniform(80, 120, len(x))
    file = table(tmp_path, rx_x=x, rx_y=y, rx_z=height, path_loss_db=loss)
    drafted = draft(scene, file, tmp_path / "study.toml", frequency=3.5e9, tx=(0, 0, 40))
    links = drafted.study.measurements()
    assert len(links) == 200
    assert sorted(set(links.rx[:, 2])) == pytest.approx(np.linspace(1.5, 30, 10).tolist())
    reason = next((each.reason for each in drafted.assumptions if each.what == "links.average"), "")
    assert reason == ("" if samples == 1 else f"{len(x)} rows at 200 positions, {samples} at each")


def test_averages_fit_the_site_and_few_links_are_warned_of(tmp_path):
    plan = tmp_path / "plan.csv"
    plan.write_text("x0,y0,x1,y1,type\n0,0,12,0,brick\n12,0,12,8,brick\n12,8,0,8,brick\n0,8,0,0,brick\n")
    scene = str(make_plan_scene(read_plan(plan), tmp_path / "flat", {}).path)
    (tmp_path / "aps.csv").write_text("ap,x,y,z\na,1,1,2.5\nb,11,7,2.5\n")
    place = np.repeat(np.arange(4), 6)
    scans = {"x": 2.0 + place, "y": 3.0, "ap": list("aaabbb") * 4, "rssi": -50.0 - np.arange(24)}
    file = table(tmp_path, **scans)
    # Three scans at each place are fewer than a stationary scan: cells, no wider than 5 % of 8 m plus the margin.
    drafted = draft(scene, file, tmp_path / "study.toml", tmp_path / "aps.csv", 2.4e9)
    assert drafted.study.links.average.size < 1.0
    # Twenty-one scans at each place.
    file = table(
        tmp_path, **{name: np.tile(values, 7) if name != "y" else values for name, values in scans.items()}
    )
    words = ("init", scene, file, "--transmitters", tmp_path / "aps.csv", "--frequency", "2.4e9")
    status, out, err = typed(*words, "-o", tmp_path / "study.toml")
    assert status == 0, err
    assert 'average = "place"' in (tmp_path / "study.toml").read_text()
    assert "8 links" in out
    assert "8 links for" in err
    assert "fewer than 5 per unknown" in err
    study = Study.load(tmp_path / "study.toml")
    (finding,) = count_unknowns(study, study.measurements())
    assert "2 offsets" in finding.problem


INJECTION = '\n\n[engine]\nname = "command"\ncommand = ["sh", "-c", "touch pwned"]\n#'


@pytest.mark.parametrize("position", ["1e300,0,2", "nan,0,2", "0,0"])
def test_an_impossible_position_is_refused(scene, tmp_path, position):
    file = table(tmp_path, x=[0.0, 5.0], y=[-20.0, -25.0], z=1.5, pl_db=[90.0, 91.0])
    status, _, err = typed("init", scene, file, "--tx", position, "-o", tmp_path / "study.toml")
    assert status == 2
    assert f"--tx {position}: must be" in " ".join(err.split())
    assert not (tmp_path / "study.toml").exists()


@pytest.mark.parametrize("breaks", ["\n", "\r\n", "\r", "\x85", "\u2028", '"\n', "'\n", '"""\n'])
def test_the_name_of_a_column_never_becomes_toml(scene, tmp_path, breaks):
    """The reasons, which quote names of columns, are comments of the study."""
    attack = INJECTION.replace("\n", breaks)
    frequency, loss = f"frequency_hz{attack}", f"path loss dB{attack}"
    file = table(tmp_path, **{"x": [0.0, 5.0], "y": [-20.0, -25.0], "z": 1.5, frequency: 3.5e9, loss: [90.0, 91.0],
                              "device": ["a", f"b{attack}"]})  # fmt: skip
    status, out, err = typed("init", scene, file, "--tx", "0,0,12", "-o", tmp_path / "study.toml")
    assert status in (0, 2), err
    # No line of what is printed begins with a part of a name.
    assert not any(
        line.lstrip().startswith(("[engine]", "command", "name =")) for line in (out + err).splitlines()
    )
    if status == 0:
        study = Study.load(tmp_path / "study.toml")
        assert study.engine.name == "replay"
        assert loss in (study.links.value, study.links.value.replace("\r\n", "\n"))


@settings(max_examples=200, deadline=None)
@given(st.text(), st.text(), st.text(max_size=20), st.floats(allow_nan=False))
def test_a_draft_says_what_was_drafted_whatever_the_names(value, reason, key, number):
    content = {"version": 1, "links": {"value": value, key: [value, number, True], "where": {key: 3}}}
    reasons = {"links": reason, "links.value": reason, f"links.{key}": reason}
    try:
        text = study_text(content, reasons)
    except InputError:  # a lone surrogate, which no TOML file can contain
        assert any("\ud800" <= letter <= "\udfff" for letter in value + key)
        return
    assert tomllib.loads(text) == content
    assert "[engine]" not in text.splitlines()
