"""`calibray init` finds what planning tools write about antennas, and the MSI files that they name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.measurements.transmitter_columns import find_angles, find_antenna_names, find_powers
from calibray.scenes.authoring import Footprints, make_scene
from calibray.study import Setup, Study
from calibray.study.draft import Draft, Given, draft

HEADERS = {
    "Atoll": (
        ["Site", "Transmitter", "Antenna", "Height (m)", "Azimuth (°)", "Mechanical Downtilt (°)",
         "Additional Electrical Downtilt (°)", "EIRP (dBm)", "Total Losses (dB)"],
        ("Azimuth (°)", "Mechanical Downtilt (°)", "Additional Electrical Downtilt (°)"), "Antenna", "EIRP (dBm)",
    ),
    "Atoll, internal names": (
        ["SITE_NAME", "TX_ID", "ANTENNA_NAME", "HEIGHT", "AZIMUT", "TILT", "EIRP"],
        ("AZIMUT", "TILT", None), "ANTENNA_NAME", "EIRP",
    ),
    "Planet": (
        ["Site ID", "Sector ID", "Antenna File", "Antenna Azimuth", "Antenna Tilt - Mechanical",
         "Antenna Tilt - Electrical", "Antenna Height", "EiRP (dBm)"],
        ("Antenna Azimuth", "Antenna Tilt - Mechanical", "Antenna Tilt - Electrical"), "Antenna File", "EiRP (dBm)",
    ),
    "operator's list": (
        ["CellID", "Lat", "Long", "AntennaModel", "Azimuth", "M_Tilt", "E_Tilt", "Total_Tilt", "TxPower_dBm"],
        ("Azimuth", "M_Tilt", "E_Tilt"), "AntennaModel", "TxPower_dBm",
    ),
    "operator's list, camel case": (
        ["cellId", "antennaType", "bearing", "mechDownTilt", "elecDownTilt", "maxPower_dBm"],
        ("bearing", "mechDownTilt", "elecDownTilt"), "antennaType", "maxPower_dBm",
    ),
    "abbreviations": (["cell", "azi", "MDT", "EDT", "ant"], ("azi", "MDT", "EDT"), "ant", None),
}  # fmt: skip
TEXTS = ("Site", "Transmitter", "Antenna", "SITE_NAME", "TX_ID", "ANTENNA_NAME", "Site ID", "Sector ID",
         "Antenna File", "CellID", "AntennaModel", "cellId", "antennaType", "cell", "ant")  # fmt: skip


@pytest.mark.parametrize("tool", HEADERS)
def test_the_header_rows_of_planning_tools_are_recognized(tool):
    header, angles, name, power = HEADERS[tool]
    frame = pd.DataFrame({column: ["a", "b"] if column in TEXTS else [4.0, 7.0] for column in header})
    keys = ("azimuth_deg", "downtilt_deg", "electrical_downtilt_deg")
    found = find_angles(frame, of_transmitters=True)
    assert tuple(found.get(key) for key in keys) == angles
    assert find_antenna_names(frame) == name
    key = "eirp_dbm" if power and "eirp" in power.lower() else "tx_power_dbm"
    assert find_powers(frame) == ({key: power} if power else {})


def test_directions_of_phones_and_powers_in_watts_are_none_of_an_antenna():
    """A drive test has the bearing of the car; only a named transmitter's counts in a table of links."""
    walk = pd.DataFrame(columns=["lat", "lon", "bearing", "rx_azimuth", "phone_tilt", "rsrp_dbm"])
    assert find_angles(walk, of_transmitters=False) == {}
    named = walk.assign(tx_azimuth=1.0, cell_downtilt=2.0)
    assert find_angles(named, False) == {"azimuth_deg": "tx_azimuth", "downtilt_deg": "cell_downtilt"}
    assert find_powers(pd.DataFrame({"power (W)": [20.0], "Power [mW]": [9.0]})) == {}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """One house 20 m wide."""
    box = np.array([shapely.box(20, -10, 40, 10)])
    house = Footprints(box, np.zeros(1), np.full(1, 9.0), ("house",), ("height",), np.zeros(1, bool), {})
    folder = tmp_path_factory.mktemp("scene")
    return str(make_scene(house, folder / "town", Frame.local(9.99, 50.01)).path)


SECTORS = pd.DataFrame(
    {
        "Cell": ["north", "south"],
        "X": [-40.0, -40.0],
        "Y": [0.0, 0.0],
        "Ground Height (m)": [110.0, 110.0],
        "Antenna Height (m)": [18.0, 19.0],
        "Antenna Model": ["K80010677 03T", "k80010677_06t"],
        "Azimuth": [20.0, 160.0],
        "MTilt": [2.0, 0.0],
        "ETilt": [3.0, 6.0],
        "EIRP (dBm)": [58.0, 60.0],
    }
)


def drafted(scene: str, folder: Path, sites: pd.DataFrame, value: str = "rx_power_dbm", **options) -> Draft:
    random = np.random.default_rng(0)
    table = {"x": random.uniform(-60, 10, 40), "y": random.uniform(-60, 60, 40), "z": 1.5, "Azimuth": 7.0}
    links = pd.DataFrame({**table, "Cell": np.repeat(["north", "south"], 20), value: -80.0})
    links.to_csv(folder / "links.csv", index=False)
    sites.to_csv(folder / "sites.csv", index=False)
    given = Given(folder / "sites.csv", frequency=2.1e9, **options)
    return draft(scene, folder / "links.csv", folder / "study.toml", given)


def sector_file(tilt: int, name: str) -> str:
    angles = np.arange(360)
    horizontal = np.minimum(12 * (((angles + 180) % 360 - 180) / 65) ** 2, 28.0)
    vertical = np.minimum(12 * (((angles - tilt + 180) % 360 - 180) / 7) ** 2, 30.0)
    cuts = (("HORIZONTAL", horizontal), ("VERTICAL", vertical))
    rows = (f"{cut} 360\n" + "".join(f"{a} {v:.2f}\n" for a, v in enumerate(values)) for cut, values in cuts)
    return f"NAME {name}\nGAIN 15.5 dBd\n" + "".join(rows)


@pytest.fixture
def files(tmp_path):
    folder = tmp_path / "msi"
    folder.mkdir()
    for tilt in (3, 6):
        name = f"K80010677_0{tilt}T"
        (folder / f"{name}.MSI").write_text(sector_file(tilt, name))
    return folder


def test_sectors_of_a_planners_table_become_a_study(scene, tmp_path):
    found = drafted(scene, tmp_path, SECTORS)
    links = found.study.links
    assert links.tx == ("X", "Y", "Antenna Height (m)")
    # The links have a column of this name, too.
    assert (links.tx_antenna.azimuth_deg, links.tx_antenna.downtilt_deg) == ("Cell_Azimuth", "MTilt")
    assert (links.tx_antenna.electrical_downtilt_deg, links.eirp_dbm) == ("ETilt", "EIRP (dBm)")
    assert found.study.antennas.tx.pattern == "tr38901"
    setup = Setup.open(found.study)
    assert np.degrees(np.unique(setup.mountings["tx"].pose.yaw)) == pytest.approx([-70.0, 70.0])
    reasons = {each.what: each.reason for each in found.assumptions}
    assert (
        "give a folder of the MSI files named in column Antenna Model with --antennas" in reasons["antennas"]
    )


def test_files_are_matched_by_name_and_hold_the_electrical_tilt(scene, tmp_path, files, monkeypatch):
    monkeypatch.chdir(files)
    here = drafted(scene, tmp_path, SECTORS, antennas=Path())
    assert [each.value for each in here.assumptions if each.what == "antennas"] == [files.name]
    found = drafted(scene, tmp_path, SECTORS, antennas=files)
    links = found.study.links
    assert links.tx_antenna.type == "Antenna Model"
    assert links.tx_antenna.electrical_downtilt_deg == 0.0
    study = Study.from_content(found.study.content(), tmp_path / "study.toml")
    patterns = {name: Path(antenna.gain_file).name for name, antenna in study.antenna_types.items()}
    assert patterns == {"K80010677 03T": "K80010677_03T.MSI", "k80010677_06t": "K80010677_06T.MSI"}
    additional = SECTORS.rename(columns={"ETilt": "Additional Electrical Downtilt"})
    section = drafted(scene, tmp_path, additional, antennas=files).study.links.tx_antenna
    assert section.electrical_downtilt_deg == "Additional Electrical Downtilt"
    # One file without a column that names it serves all.
    (files / "K80010677_06T.MSI").unlink()
    alone = drafted(scene, tmp_path, SECTORS.drop(columns="Antenna Model"), antennas=files)
    assert alone.study.antennas.tx.pattern == "msi/K80010677_03T.MSI"


def test_the_electrical_tilt_of_the_table_is_used_if_no_file_contains_one(scene, tmp_path, files):
    for file in files.iterdir():
        file.write_text(sector_file(0, file.stem))
    found = drafted(scene, tmp_path, SECTORS, antennas=files)
    assert found.study.links.tx_antenna.electrical_downtilt_deg == "ETilt"
    reasons = {each.what: each.reason for each in found.assumptions}
    assert "main lobes in the files are horizontal" in reasons["links.tx_antenna.electrical_downtilt_deg"]
    (files / "K80010677_06T.MSI").write_text(sector_file(6, "K80010677_06T"))
    mixed = drafted(scene, tmp_path, SECTORS, antennas=files)
    assert mixed.study.links.tx_antenna.electrical_downtilt_deg == 0.0


def test_a_missing_file_or_angle_is_named(scene, tmp_path, files):
    (files / "K80010677_06T.MSI").unlink()
    with pytest.raises(
        InputError, match=r"no file for 'k80010677_06t' of column 'Antenna Model'.*give the name of a file"
    ):
        drafted(scene, tmp_path, SECTORS, antennas=files)
    with pytest.raises(InputError, match=r"contains no \*.msi"):
        drafted(scene, tmp_path, SECTORS, antennas=tmp_path)
    gap = SECTORS.assign(Azimuth=[20.0, None], MTilt=[2.0, 200.0])
    found = drafted(scene, tmp_path, gap)
    reasons = {each.what: each.reason for each in found.assumptions}
    assert "no number in 1 of 2 rows" in reasons["links.tx_antenna.azimuth_deg"]
    assert "200 is not an angle" in reasons["links.tx_antenna.downtilt_deg"]
    assert found.study.links.tx_antenna.azimuth_deg is None


ROD = "NAME rod\nGAIN 5 dBi\nHORIZONTAL 360\n" + "".join(f"{angle} 0.3\n" for angle in range(360))
ROD += "VERTICAL 360\n" + "".join(f"{angle} {min(angle % 180, 20)}\n" for angle in range(360))


@pytest.mark.parametrize("omnidirectional", ["rod", "dipole"])
def test_empty_angles_of_omnidirectional_antennas_count_as_zero(scene, tmp_path, files, omnidirectional):
    """Planning tools leave them empty; the sector keeps its azimuth."""
    (files / "rod.msi").write_text(ROD)
    sites = SECTORS.assign(Azimuth=[20.0, None], MTilt=[2.0, None])
    sites["Antenna Model"] = ["K80010677 03T", omnidirectional]
    found = drafted(scene, tmp_path, sites, antennas=files)
    section = found.study.links.tx_antenna
    assert (section.azimuth_deg, section.downtilt_deg) == ("Cell_Azimuth", "MTilt")
    pose = Setup.open(found.study).mountings["tx"].pose
    assert np.degrees(np.unique(pose.yaw)) == pytest.approx([70.0, 90.0])
    assert np.degrees(np.unique(pose.downtilt)) == pytest.approx([0.0, 2.0])
    reasons = {each.what: each.reason for each in found.assumptions}
    assert ("except dipole" in reasons["links.tx_antenna.type"]) == (omnidirectional == "dipole")


def test_directional_antennas_without_an_angle_are_named(scene, tmp_path, files, caplog):
    with pytest.raises(
        InputError, match=r"sites.csv: column 'Cell_Azimuth' in row 3 contains no number; enter"
    ):
        drafted(scene, tmp_path, SECTORS.assign(Azimuth=[20.0, None]), antennas=files)
    assert not caplog.messages
    drafted(scene, tmp_path, SECTORS.drop(columns="Azimuth"), antennas=files)
    assert "no azimuths, so directional antennas point east" in caplog.text
    # A column without any angle states nothing.
    found = drafted(scene, tmp_path, SECTORS.assign(MTilt=np.nan), antennas=files)
    assert found.study.links.tx_antenna.downtilt_deg == 0.0


def test_unnamed_antennas_are_refused_with_the_names_of_omnidirectional_ones(scene, tmp_path, files):
    sites = SECTORS.copy()
    sites["Antenna Model"] = ["K80010677 03T", None]
    remedy = "give the name of a file, or 'iso' or 'dipole' for an omnidirectional antenna"
    with pytest.raises(InputError, match=rf"column 'Antenna Model' in row 3 is empty; {remedy}"):
        drafted(scene, tmp_path, sites, antennas=files)
    sites["Antenna Model"] = ["K80010677 03T", "OMNI"]
    with pytest.raises(InputError, match=rf"no file for 'OMNI' .*{remedy}"):
        drafted(scene, tmp_path, sites, antennas=files)


def test_reference_signals_do_not_take_the_power_of_the_whole_carrier(scene, tmp_path):
    found = drafted(scene, tmp_path, SECTORS, value="rsrp_dbm")
    assert found.study.links.quantity == "rsrp"
    assert found.study.links.eirp_dbm is None
