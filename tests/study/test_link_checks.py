"""Each classic mistake, planted, is named; the same links without it raise no suspicion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely
from typer.testing import CliRunner

from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.cli.app import app
from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.scenes.authoring import Footprints, make_plan_scene, make_scene, read_plan
from calibray.scenes.checks import SceneSurfaces, building_outlines
from calibray.study import Setup, Study
from calibray.study.link_checks import count_unknowns, examine

MAST = np.array([-5.0, 3.0, 25.0])
BEARING = np.radians(30.0)  # where the mast's sector looks, clockwise from north


@pytest.fixture(scope="module")
def town(tmp_path_factory) -> Path:
    """Four blocks along a street from west to east, none of them symmetric to another."""
    folder = tmp_path_factory.mktemp("town")
    blocks = [(-80, 10, -45, 60), (-35, 10, 60, 30), (-80, -70, -20, -10), (-10, -40, 75, -10)]
    polygon = np.array([shapely.box(*block) for block in blocks])
    names = tuple(f"house-{k}" for k in range(4))
    heights = ("height",) * 4
    houses = Footprints(polygon, np.zeros(4), np.full(4, 12.0), names, heights, np.zeros(4, bool), {})
    made = make_scene(
        houses,
        folder,
        margin=20.0,
    )
    return made.path.parent


def links(seed: int = 0) -> pd.DataFrame:
    """Receivers along the street and a side street to the north, with a sector towards 30 degrees."""
    rng = np.random.default_rng(seed)
    rx = np.column_stack([rng.uniform(-78, 75, 60), rng.uniform(-9, 9, 60), np.full(60, 1.5)])
    rx[40:, :2] = np.column_stack([rng.uniform(-44, -36, 20), rng.uniform(12, 58, 20)])
    away = rx - MAST
    distance = np.linalg.norm(away, axis=1)
    azimuth = np.arctan2(away[:, 1], away[:, 0])
    off = (azimuth - (np.pi / 2 - BEARING) + np.pi) % (2 * np.pi) - np.pi
    gain = 8 - np.minimum(12 * (np.degrees(off) / 65) ** 2, 30)
    loss = 20 * np.log10(4 * np.pi * distance * 3.5e9 / 299792458) + 4 + rng.normal(0, 2, 60) - gain
    return pd.DataFrame({"x": rx[:, 0], "y": rx[:, 1], "z": rx[:, 2], "loss": loss})


def suspicions(town: Path, frame: pd.DataFrame, **changes: object) -> str:
    name = f"links-{abs(hash(frame.to_csv()))}.csv"
    frame.to_csv(town / name, index=False)
    yaw = float(np.pi / 2 - BEARING)
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": 3.5e9},
        "links": {"file": name, "tx": MAST.tolist(), "rx": ["x", "y", "z"], "value": "loss"},
        "antennas": {"tx": {"pattern": "tr38901", "polarization": "V", "orientation": [yaw, 0, 0]}},
        "parameters": {"walls.relative_permittivity": {"bounds": [1.5, 12.0]}},
    }
    content["links"] |= changes.pop("links", {})
    content["antennas"]["tx"] |= changes.pop("antenna", {})
    study = Study.from_content(content | changes, town / "study.toml")
    return "\n".join(finding.problem for finding in examine(study, study.measurements()))


def test_sound_links_raise_no_suspicion(town):
    assert suspicions(town, links()) == ""


def test_a_study_without_an_offset_has_no_unknown_for_it(town):
    links().head(7).to_csv(town / "few.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": 3.5e9},
        "links": {"file": "few.csv", "tx": MAST.tolist(), "rx": ["x", "y", "z"], "value": "loss"},
        "parameters": {"walls.relative_permittivity": {"bounds": [1.5, 12.0]}},
    }
    without, one = (Study.from_content(content | more, town / "study.toml") for more in ({}, {"offset": {}}))
    assert count_unknowns(without, without.measurements()) == ()
    (finding,) = count_unknowns(one, one.measurements())
    assert "7 links for 2 unknowns" in finding.problem


def test_coefficients_of_nuisance_terms_are_unknowns(town):
    table = links().head(24)
    table.assign(street=[f"s{k % 4}" for k in range(24)]).to_csv(town / "streets.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": 3.5e9},
        "links": {"file": "streets.csv", "tx": MAST.tolist(), "rx": ["x", "y", "z"], "value": "loss"},
        "parameters": {"walls.relative_permittivity": {"bounds": [1.5, 12.0]}},
    }

    def problem(**term):
        study = Study.from_content(content | {"nuisance": {"a": term}}, town / "study.toml")
        return "".join(finding.problem for finding in count_unknowns(study, study.measurements()))

    text = problem(by="constant", per="street")
    assert "24 links for 5 unknowns (1 parameters, 0 offsets, 4 coefficients of [nuisance])" in text
    assert problem(by="constant", per="street", prior="auto") == problem(by="log_distance") == ""
    assert "24 coefficients" in problem(by="constant", per="cluster", cluster_m=0.01)


@pytest.mark.parametrize(
    ("mistake", "named"),
    [
        (lambda t: t.assign(x=t.y, y=t.x), "if x and y are swapped"),
        (lambda t: t.assign(x=-t.y, y=t.x), "if they are turned by 90 degrees"),
        (lambda t: t.assign(x=t.x + 200), "are outside the scene; their centre is"),
        (lambda t: t.assign(x=t.x + 900 * (t.index == 7)), "1 of 60 receivers are outside the scene"),
        (lambda t: t.assign(z=t.z - 4), "60 of 60 receivers are below the ground"),
        (lambda t: t.assign(z=t.z + 540), "60 of 60 receivers are more than 300 m above the whole scene"),
        (lambda t: t.assign(y=np.where(t.index < 5, 20.0, t.y), x=np.where(t.index < 5, 10.0 + t.index, t.x)),
         "5 of 60 receivers are inside buildings"),
        (lambda t: t.assign(loss=t.loss - 30), "path losses are below free-space loss, with"),
        (lambda t: t.assign(z=np.where(t.index < 5, 0.0, t.z)), "5 of 60 receivers touch the ground"),
    ],
    ids=["swapped", "turned", "origin", "jump", "underground", "altitudes", "indoors", "watts", "height"],
)  # fmt: skip
def test_a_planted_mistake_of_links_is_named(town, mistake, named):
    assert named in suspicions(town, mistake(links()))


def test_links_of_several_transmitters_to_a_receiver_outside_the_scene_are_counted(town):
    frame = links()
    away = frame.index.isin([8, 9])
    frame = frame.assign(x=np.where(away, 900.0, frame.x), y=np.where(away, 0.0, frame.y))
    frame = frame.assign(mast=MAST[0] + 0.5 * (frame.index % 2))
    text = suspicions(town, frame, links={"tx": ["mast", *MAST[1:].tolist()]})
    assert "1 of 59 receivers are outside the scene" in text
    assert "(links there: 2, the first in row 10)" in text


def test_receivers_indoors_of_a_transmitter_outdoors_are_no_mistake(town):
    """All stand in two of the blocks, so that turned axes would put them outdoors; waves reach them through walls."""
    frame = links()
    inside = frame.assign(
        x=np.where(frame.x < 0, frame.x * 0.4 - 46, frame.x * 0.8 + 1), y=-12 - frame.index / 3
    )
    inside = inside.assign(loss=inside.loss + 15)
    named = "60 of 60 receivers are inside buildings"
    assert named in suspicions(town, inside)
    assert named not in suspicions(town, inside, trace={"refraction": True})
    assert "receivers are" not in suspicions(town, inside, trace={"refraction": True})
    # Half of the receivers outdoors, and the transmitter in a building.
    some = pd.concat([frame.iloc[:30], inside.iloc[30:]])
    indoors = {"tx": [10.0, 20.0, 5.0]}
    assert "30 of 60 receivers are inside buildings" in suspicions(town, some)
    assert "inside buildings" not in suspicions(town, some, links=indoors, trace={"refraction": True})


@pytest.mark.parametrize(("unit", "is_named"), [("ns", False), ("us", True), ("m", False)])
def test_delays_of_paths_far_longer_than_the_scene_are_named(town, unit, is_named):
    """Delay spreads of some 30 ns in a town of 200 m; in microseconds they are those of paths of 9 km."""
    frame = links().assign(spread=np.linspace(5.0, 60.0, 60))
    observables = {"ds": {"kind": "rms_delay_spread", "column": "spread", "unit": unit}}
    named = "column 'spread' [us] corresponds to a path length of 9743 m"
    assert (named in suspicions(town, frame, observables=observables)) == is_named
    assert is_named or suspicions(town, frame, observables=observables) == ""


def test_a_corridor_that_guides_waves_is_no_mistake(tmp_path):
    """By the ray tracer, walls, floor and ceiling gain up to 11 dB over free space; watts for milliwatts are 30 dB."""
    wall = np.array([[0, 0, 40, 0], [0, 2.4, 40, 2.4], [0, 0, 0, 2.4], [40, 0, 40, 2.4]], dtype=float)
    rows = "".join(",".join(map(str, line)) + ",plasterboard,0.1\n" for line in wall.tolist())
    (tmp_path / "plan.csv").write_text("x0,y0,x1,y1,type,thickness\n" + rows)
    scene = make_plan_scene(read_plan(tmp_path / "plan.csv"), tmp_path / "hall", {}).path
    tx = [0.6, 1.2, 2.2]
    frame = pd.DataFrame({"x": np.linspace(2, 39, 60), "y": 0.9, "z": 1.4, "loss": 90.0})
    frame.to_csv(tmp_path / "links.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": str(scene), "frequency": 60e9},
        "links": {"file": "links.csv", "tx": tx, "rx": ["x", "y", "z"], "value": "loss"},
        "trace": {"max_depth": 4, "samples": 100_000},
        "parameters": {"plasterboard_wall.relative_permittivity": {"bounds": [1.5, 12.0]}},
    }
    study = Study.from_content(content, tmp_path / "study.toml")
    setup = Setup.open(study)
    modelled = engines.make(setup).path_loss(np.array([[2.0]]))[0]
    named = "path losses are below free-space loss"
    for shift, is_named in ((0.0, False), (-30.0, True)):
        frame.assign(loss=modelled + shift).to_csv(tmp_path / "links.csv", index=False)
        problems = [finding.problem for finding in examine(study, study.measurements())]
        assert any(named in problem for problem in problems) == is_named


def test_the_gain_of_an_array_is_no_mistake(town):
    """64 antennas have 18 dB more than one of 8 dBi: path losses as much below free space are no suspicion."""
    array = {"rows": 8, "columns": 8}
    frame = links()
    distance = np.linalg.norm(frame[["x", "y", "z"]] - MAST, axis=1)
    best = frame.assign(loss=20 * np.log10(4 * np.pi * distance * 3.5e9 / 299792458) - 26)
    named = "path losses are below free-space loss"
    assert named in suspicions(town, best)
    assert named not in suspicions(town, best, antenna=array)
    assert named in suspicions(town, best.assign(loss=best.loss - 10), antenna=array)


def test_transmitters_below_the_ground_are_named_with_their_table(town):
    """Sectors at one position count separately, and the height is in the table of transmitters."""
    frame = links().assign(transmitter=[f"S{1 + k % 3}" for k in range(60)])
    x, y, z = MAST.tolist()
    table = pd.DataFrame({"transmitter": ["S1", "S2", "S3"], "tx": x, "ty": y, "h": [-3.0, -3.0, z]})
    table.to_csv(town / "sites.csv", index=False)
    section = {"transmitters": "sites.csv", "tx": ["tx", "ty", "h"]}
    path = town / "sites.csv"
    assert f"2 of 3 transmitters (S1, S2 of {path}) are below the ground" in suspicions(
        town, frame, links=section
    )


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"links": {"tx": [10.0, 20.0, 5.0]}}, "1 of 1 transmitters are inside buildings"),
        ({"links": {"tx": [*MAST[:2].tolist(), -3.0]}}, "1 of 1 transmitters are below the ground"),
        ({"links": {"tx": [*MAST[:2].tolist(), 548.0]}}, "1 of 1 transmitters are more than 300 m above"),
        (
            {"antenna": {"orientation": [float(BEARING), 0, 0]}},
            "fit antennas.tx better with a yaw of 1.05 rad",
        ),
        ({"antenna": {"orientation": [60.0, 0, 0]}}, "is more than a full turn"),
    ],
    ids=["walls", "underground", "altitude", "compass", "degrees"],
)
def test_a_planted_mistake_of_the_study_is_named(town, changes, named):
    assert named in suspicions(town, links(), **changes)


@pytest.mark.parametrize(
    ("columns", "keys", "named"),
    [
        (
            {"z": "height_ft"},
            {"rx": ["x", "y", "height_ft"]},
            "'height_ft' implies a unit of 0.3048 m",
        ),
        ({"z": "z_m"}, {"rx": ["x", "y", "z_m"]}, ""),
        (
            {"loss": "rx_dbm"},
            {"value": "rx_dbm", "quantity": "received_power", "tx_power_dbm": "power_w"},
            "implies watts",
        ),
    ],
)
def test_units_of_names_that_the_study_does_not_state_are_named(town, columns, keys, named):
    table = links().assign(power_w=20.0).rename(columns=columns)
    if "rx_dbm" in table:
        table["rx_dbm"] = table["power_w"] - table["rx_dbm"]
    found = suspicions(town, table, links=keys)
    assert named in found
    assert bool(named) == bool(found)


@pytest.mark.parametrize("position", ["scene", "geographic"])
def test_the_remedy_for_a_unit_can_be_followed(town, position):
    """A unit of positions cannot be stated for degrees."""
    frame = Frame.local(9.99, 50.01)
    table = links().assign(height_ft=5.0)
    if position == "geographic":
        table["x"], table["y"], _ = frame.to_geographic(table[["x", "y", "z"]].to_numpy()).T
    table.to_csv(town / f"{position}.csv", index=False)
    tx = frame.to_geographic(MAST) if position == "geographic" else MAST
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": 3.5e9, "origin": [9.99, 50.01]},
        "links": {
            "file": f"{position}.csv", "tx": tx.tolist(), "rx": ["x", "y", "height_ft"], "value": "loss",
            "position": position,
        },
        "parameters": {"walls.relative_permittivity": {"bounds": [1.5, 12.0]}},
    }  # fmt: skip
    study = Study.from_content(content, town / "study.toml")
    (remedy,) = [item.remedy for item in examine(study, study.measurements()) if "height_ft" in item.problem]
    assert ("links.position_unit" in remedy) == (position == "scene")


def test_upward_tilts_and_relative_gains_are_named(town):
    """An antenna of 65 degrees has a mean gain of a tenth of its largest one: absolute gains reach 10 dBi."""
    azimuth, elevation = (
        angle.ravel() for angle in np.meshgrid(np.arange(-180, 180, 5), np.arange(-90, 91, 5))
    )
    gain = -np.minimum(12 * (azimuth / 65) ** 2 + 12 * (elevation / 65) ** 2, 30)
    grid = pd.DataFrame({"azimuth_deg": azimuth, "elevation_deg": elevation, "gain_dbi": gain})
    for largest, tilt, named in ((0.0, 6.0, ("relative",)), (9.8, -6.0, ("point upwards",)), (9.8, 6.0, ())):
        grid.assign(gain_dbi=gain + largest).to_csv(town / f"{largest}.csv", index=False)
        mounted = {"tx_antenna": {"azimuth_deg": 30.0, "downtilt_deg": "tilt"}}
        antenna = {"pattern": f"{largest}.csv", "orientation": [0.0, 0.0, 0.0]}
        found = suspicions(town, links().assign(tilt=tilt), links=mounted, antenna=antenna)
        assert [word for word in ("relative", "point upwards") if word in found] == list(named)


@pytest.mark.parametrize(
    ("column", "quantity", "named"),
    [
        ("rsrp_dbm", "path_gain", "has the name of a received power"),
        ("path_gain_db", "rsrp", "has the name of a loss or gain"),
    ],
)
def test_decibels_taken_for_others(town, column, quantity, named):
    frame = links().rename(columns={"loss": column}).assign(**{column: -links()["loss"]})
    offset = {"offset": {}} if quantity == "rsrp" else {}
    assert named in suspicions(town, frame, links={"value": column, "quantity": quantity}, **offset)


def test_links_of_another_town_are_refused(town):
    with pytest.raises(InputError, match="all receivers are more than"):
        suspicions(town, links().assign(x=links().x + 690_000))


def test_transmitters_far_from_the_scene_are_named(town):
    """One latitude with a typing error, or longitude and latitude swapped in the whole table."""
    sites = pd.DataFrame({"cell": ["A", "B"], "tx_x": [-5.0, 20.0], "tx_y": [3.0, 111_000.0], "tx_z": 25.0})
    sites.to_csv(town / "far.csv", index=False)
    frame = links().assign(cell=["A", "B"] * 30)
    keys = {"tx": ["tx_x", "tx_y", "tx_z"], "transmitters": "far.csv", "transmitter": "cell"}
    assert "B is more than" in suspicions(town, frame, links=keys)
    sites.assign(tx_x=690_000.0).to_csv(town / "far.csv", index=False)
    with pytest.raises(InputError, match=r"far\.csv: A, B are more than .* check the position"):
        suspicions(town, frame, links=keys)
    with pytest.raises(InputError, match=r"csv: the transmitter is more than"):
        suspicions(town, links(), links={"tx": [690_000.0, 0.0, 25.0]})


SUNK = "60 of 60 receivers are below the ground; check heights and their datum"


def test_run_warns_before_it_traces(town, caplog):
    links().assign(z=-4.0).to_csv(town / "sunk.csv", index=False)
    (town / "sunk.toml").write_text(
        'version = 1\n[scene]\nfile = "scene.xml"\nfrequency = 3.5e9\n[links]\nfile = "sunk.csv"\n'
        'tx = [-5.0, 3.0, 25.0]\nrx = ["x", "y", "z"]\nvalue = "loss"\n[trace]\nsamples = 1000\nmax_depth = 0\n'
        '[parameters]\n"walls.relative_permittivity" = { bounds = [1.5, 12.0] }\n'
    )
    result = CliRunner().invoke(app, ["run", str(town / "sunk.toml"), "--out", str(town / "out")])
    assert "Warning: " in result.stderr
    assert result.stderr.count(SUNK) == 1
    assert result.exit_code == 2  # and no path leads there
    assert not caplog.messages
    with pytest.raises(InputError, match="no path reaches any"):
        calibrate(Study.load(town / "sunk.toml"))
    assert SUNK in caplog.text


def test_transforms_of_shapes_are_applied(tmp_path, town):
    """A rectangle is a ground of 400 m, and a cube is a house of 12 m; neither has a file."""
    reference = '<ref id="mat-walls" name="bsdf"/></shape>'
    shapes = (
        '<shape type="rectangle" id="mesh-plane"><transform name="to_world"><scale value="200"/></transform>'
        f"{reference}"
        '<shape type="cube" id="mesh-block"><transform name="to_world"><scale x="40" y="9" z="6"/>'
        f'<translate x="-20" y="20" z="6"/></transform>{reference}'
    )
    material = '<bsdf type="itu-radio-material" id="mat-walls"><string name="type" value="concrete"/></bsdf>'
    scene = tmp_path / "scene.xml"
    scene.write_text(f'<scene version="2.1.0">{material}{shapes}</scene>')
    surfaces = SceneSurfaces.read(scene)
    assert surfaces.bounds.tolist() == [-200, -200, 0, 200, 200, 12]
    assert surfaces.under_roof([[-20, 20, 1.5], [30, 20, 1.5]]).tolist() == [True, False]
    assert surfaces.underground([[30, 20, -1.0], [30, 20, 1.5]]).tolist() == [True, False]
    assert surfaces.touching([[30, 20, 0.009], [30, 20, 0.011], [-20, 20, 12.0]]).tolist() == [
        True,
        False,
        True,
    ]
    assert building_outlines(scene).bounds == pytest.approx((-60, 11, 20, 29))


def test_a_scene_in_millimetres_is_named(tmp_path, town):
    scene = tmp_path / "scene.xml"
    text = (town / "scene.xml").read_text().replace('value="meshes/', f'value="{town}/meshes/')
    scale = '<transform name="to_world"><scale value="1000"/></transform>'
    scene.write_text(text.replace('<boolean name="face_normals"', f'{scale}<boolean name="face_normals"'))
    assert "m, as if in millimetres" in suspicions(
        town, links(), scene={"file": str(scene), "frequency": 3.5e9}
    )


def test_averages_that_span_much_of_the_scene_are_named(town):
    average = {"by": "cell", "size": 20.0}
    assert "averages span 20 m, " in suspicions(town, links(), links={"average": average})
    average["size"] = 5.0
    assert "averages span" not in suspicions(town, links(), links={"average": average})


def test_a_log_with_many_rows_while_parked_is_named(town):
    """Kish's effective number: n^2 over the sum of squares; equal repeats of every position change nothing."""
    frame = links()
    repeats = np.where(np.arange(len(frame)) == 7, 100, 1)
    parked = frame.loc[np.repeat(frame.index, repeats)].reset_index(drop=True)
    parked["time"] = np.arange(len(parked))
    effective = len(parked) ** 2 / np.sum(repeats**2)
    found = suspicions(town, parked)
    assert "100 of 159 links have the same position" in found
    assert f"60 positions are equivalent to about {effective:.0f} positions" in found
    equal = frame.loc[np.repeat(frame.index, 10)].reset_index(drop=True)
    assert suspicions(town, equal.assign(time=np.arange(len(equal)))) == ""
    assert suspicions(town, parked, links={"average": "place"}) == ""


def test_a_parked_receiver_whose_gps_positions_spread_is_named(town):
    rng, frame = np.random.default_rng(0), links()
    parked = frame.loc[[*frame.index, *[7] * 99]].reset_index(drop=True)
    parked.loc[60:, ["x", "y"]] += rng.normal(0, 1, (99, 2))
    metre = np.array([1 / (111_320 * np.cos(np.radians(50))), 1 / 111_230])
    geographic = {
        "position": "geographic",
        "tx": [*(np.array([10, 50]) + MAST[:2] * metre).tolist(), MAST[2]],
    }
    scene = {"file": "scene.xml", "frequency": 3.5e9, "origin": [10.0, 50.0]}

    def found(table: pd.DataFrame, **changes: object) -> str:
        table = table.assign(
            **dict(zip("xy", (np.array([10, 50]) + table[["x", "y"]] * metre).T.values, strict=True))
        )
        return suspicions(town, table, links=geographic | changes, scene=scene)

    assert "links have the same position within 5 m" in found(parked)
    assert found(parked, average={"by": "cell", "size": 5.0}) == ""
    assert found(frame) == ""


def test_a_log_in_another_time_zone_than_its_track_is_named(town):
    frame = links()
    frame["x"], frame["y"] = 10 + frame["x"] / 71_700, 50 + frame["y"] / 111_230
    clock = pd.date_range("2026-05-04T09:00", periods=len(frame), freq="2min")
    points = "".join(
        f'<trkpt lat="{y}" lon="{x}"><time>{time.isoformat()}Z</time></trkpt>'
        for x, y, time in zip(frame["x"], frame["y"], clock, strict=True)
    )
    (town / "walk.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    scene = {"file": "scene.xml", "frequency": 3.5e9, "origin": [10.0, 50.0]}

    def found(ahead: str, **track: object) -> str:
        table = frame.drop(columns=["x", "y"]).assign(time=clock + pd.Timedelta(ahead))
        steps = {
            "position": "geographic",
            "tx": [10 + MAST[0] / 71_700, 50 + MAST[1] / 111_230, MAST[2]],
            "rx": ["track_longitude", "track_latitude", 1.5],
            "track": {"file": "walk.gpx", "time": "time", "longest_gap": 120.0} | track,
        }
        return suspicions(town, table, links=steps, scene=scene)

    assert found("0 min") == found("1 h", clock=3600.0) == ""
    assert (
        "30 rows without a position on the track, left out; links.track.clock = 3600 would keep more of them"
        in found("1 h")
    )
