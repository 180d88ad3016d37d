"""Measured antenna patterns: a table of a known pattern radiates like it, in replay and in Sionna RT; refused files."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from sionna.rt import antenna_pattern

import calibray as cb
from calibray.engines import RadioSettings, Request, fingerprint
from calibray.errors import InputError
from calibray.fields import path_gains
from calibray.paths import Paths
from calibray.scenes import Scene, read_scene
from calibray.study import Study
from calibray.tracing import cache
from calibray.tracing.antennas import AntennaPattern
from calibray.tracing.gain_table import GainTable, read_gain_table
from calibray.tracing.settings import POLARIZATIONS, Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from calibray.tracing.sionna.scene import tabulated_pattern
from small_scenes import block, write_scene

FREQUENCY = 3.5e9
TILTED = (0.7, -0.4, 0.3)
HEADER = "azimuth_deg,elevation_deg,gain_dbi\n"


def grid(first: float, last: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths and elevations of a full grid, flat."""
    azimuth = np.arange(first, last + step / 2, step)
    elevation = np.arange(-90, 90 + step / 2, step)
    return tuple(axis.ravel() for axis in np.meshgrid(azimuth, elevation))


def sionna_gain(pattern: str, azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Gain of a pattern of Sionna RT, at least -100 dBi."""
    function = getattr(antenna_pattern, f"v_{pattern}_pattern")
    field = function(mi.Float(np.radians(90 - elevation)), mi.Float(np.radians(azimuth)))
    return 20 * np.log10(np.maximum(np.abs(np.array(field.real)), 1e-5))


def write(file: Path, azimuth: np.ndarray, elevation: np.ndarray, gain: np.ndarray) -> Path:
    rows = (f"{a:g},{e:g},{g:.6f}\n" for a, e, g in zip(azimuth, elevation, gain, strict=True))
    file.write_text(HEADER + "".join(rows))
    return file


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Patterns of Sionna RT every degree; also tr38901 rotated by 40 degrees."""
    folder, azimuth, elevation = tmp_path_factory.mktemp("patterns"), *grid(-180, 180, 1)
    files = {
        name: str(write(folder / f"{name}.csv", azimuth, elevation, sionna_gain(name, azimuth, elevation)))
        for name in ("iso", "dipole", "tr38901")
    }
    rotated = sionna_gain("tr38901", (azimuth + 220) % 360 - 180, elevation)
    return files | {"rotated": str(write(folder / "rotated.csv", azimuth, elevation, rotated))}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    ground = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    houses = {"one": block((-6, 6, 0), (4, 14, 9)), "two": block((0, -16, 0), (12, -8, 7))}
    folder = tmp_path_factory.mktemp("scene")
    return read_scene(write_scene(folder, {"ground": ground, **houses}), FREQUENCY)


LINKS = SimpleNamespace(
    tx=np.tile([-20.0, 1.0, 6.0], (4, 1)),
    rx=np.array([[10.0, 2, 1.5], [25, -3, 2], [-4, -12, 1.5], [2, 20, 1.7]]),
)
SETTINGS = TraceSettings(max_depth=2, samples=20_000, diffraction=True)


def tracer(scene: Scene, tx: Antenna, rx: Antenna) -> Tracer:
    return Tracer(scene, FREQUENCY, SETTINGS, tx, rx)


# A table of a known pattern


@pytest.fixture(scope="module")
def paths(scene: Scene) -> Paths:
    return tracer(scene, Antenna(), Antenna()).trace(LINKS)


@pytest.mark.parametrize("polarization", POLARIZATIONS)
@pytest.mark.parametrize("pattern", ["iso", "dipole", "tr38901"])
def test_a_table_of_a_pattern_radiates_like_the_pattern(
    paths: Paths, tables: dict[str, str], pattern: str, polarization: str
) -> None:
    """To 0.01 dB of the stronger port for every path; none comes near a null narrower than the table's step."""
    zenith, azimuth = paths.departure.T
    direction = np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1
    )
    assert len(direction) > 20
    exact, tabulated = (
        AntennaPattern.of(Antenna(name, polarization, TILTED)).jones_vectors(direction)
        for name in (pattern, tables[pattern])
    )
    error = np.abs(tabulated - exact).max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2))
    assert error.max() < (1e-6 if pattern == "iso" else 1.2e-3)  # 0.01 dB
    if pattern != "iso":
        assert error.max() > 1e-6  # not the pattern itself


def test_sionna_and_replay_give_the_same_gains_with_a_table(scene: Scene, tables: dict[str, str]) -> None:
    antennas = Antenna(tables["tr38901"], "cross", TILTED), Antenna(tables["dipole"], "H", (0.0, 0.2, 0.5))
    trace = tracer(scene, *antennas).find_paths(LINKS)
    theirs, ours = trace.path_gains(), path_gains(trace.paths())
    assert ours.shape == theirs.shape
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-4 * np.abs(theirs).max())


def test_a_rotated_table_gives_other_gains_unless_the_antenna_is_rotated_back(
    scene: Scene, tables: dict[str, str]
) -> None:
    def gains(name: str, yaw: float) -> np.ndarray:
        return path_gains(tracer(scene, Antenna(name, "V", (yaw, 0, 0)), Antenna()).trace(LINKS))

    plain, rotated, back = (
        gains("tr38901", 0.0),
        gains(tables["rotated"], 0.0),
        gains(tables["rotated"], np.radians(40)),
    )
    assert np.abs(rotated / plain - 1).max() > 0.5
    np.testing.assert_allclose(back, plain, rtol=2e-3)


def test_gain_is_interpolated_in_decibel_across_the_seam_and_to_the_poles() -> None:
    rng = np.random.default_rng(3)
    table = GainTable(-180.0, rng.uniform(-20, 3, (13, 24)))
    assert table.steps_deg == (15.0, 15.0)
    np.testing.assert_allclose(table.gain(-165.0, -60.0), table.gain_dbi[2, 1])
    np.testing.assert_allclose(table.gain(172.5, 30.0), table.gain_dbi[8, [23, 0]].mean())
    np.testing.assert_allclose(table.gain(187.5, 37.5), table.gain_dbi[8:10, 0:2].mean())
    np.testing.assert_allclose(table.gain([-180.0, 180.0, 540.0], 90.0), table.gain_dbi[12, 0])


def test_an_azimuth_that_rounding_moves_below_the_first_one_has_its_gain() -> None:
    table = GainTable(0.0, np.random.default_rng(3).uniform(-20, 3, (13, 24)))
    for below in (1e-16, 1e-15, 1e-14, 1e-13):
        np.testing.assert_allclose(table.gain(-below, 0.0), table.gain_dbi[6, 0], atol=1e-9)


def test_sionnas_pattern_function_interpolates_like_the_table() -> None:
    """In random directions and at the edges of the grid, for a grid from 0 and one from -180 degrees."""
    rng = np.random.default_rng(4)
    azimuth = np.concatenate([rng.uniform(-180, 180, 500), [-180, 180, 0, 179.99, -179.99, 0, 0]])
    elevation = np.concatenate([np.degrees(np.arcsin(rng.uniform(-1, 1, 500))), [0, 0, 0, 1, 1, 90, -90]])
    for table in (
        GainTable(-180.0, rng.uniform(-20, 3, (37, 72))),
        GainTable(0.0, rng.uniform(-20, 3, (13, 24))),
    ):
        field = tabulated_pattern(table)(mi.Float(np.radians(90 - elevation)), mi.Float(np.radians(azimuth)))
        gain = 20 * np.log10(np.array(field.real, dtype=float))
        np.testing.assert_allclose(gain, table.gain(azimuth, elevation), atol=2e-3)


@pytest.mark.parametrize(("pattern", "efficiency"), [("iso", 1.0), ("dipole", 1.0), ("tr38901", 0.657)])
def test_efficiency_is_the_mean_gain_over_the_sphere(
    tables: dict[str, str], pattern: str, efficiency: float
) -> None:
    """The value of tr38901 is that of Sionna RT's `compute_gain`."""
    assert read_gain_table(tables[pattern]).efficiency == pytest.approx(efficiency, abs=2e-3)


# Layout of the file


def test_the_layout_of_the_file_does_not_matter(tmp_path: Path) -> None:
    def gain(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
        return 3 * np.cos(np.radians(azimuth - 20)) * np.cos(np.radians(elevation)) - 1

    tables = []
    for first, last in ((-180, 180), (-180, 170), (0, 360), (0, 350)):
        azimuth, elevation = grid(first, last, 10)
        order = np.random.default_rng(1).permutation(len(azimuth))
        file = write(tmp_path / "grid.csv", azimuth[order], elevation[order], gain(azimuth, elevation)[order])
        tables.append(read_gain_table(file))
    directions = np.random.default_rng(2).uniform((-180, -90), (180, 90), (200, 2)).T
    for table in tables[1:]:
        np.testing.assert_allclose(table.gain(*directions), tables[0].gain(*directions), atol=1e-9)
    assert tables[0].digest() == tables[1].digest() != tables[2].digest() == tables[3].digest()


def rows() -> list[str]:
    """A grid every 10 degrees as lines of CSV; the header is line 1."""
    azimuth, elevation = grid(-180, 180, 10)
    return [f"{a:g},{e:g},0\n" for a, e in zip(azimuth, elevation, strict=True)]


def replaced(index: int, line: str | None) -> list[str]:
    lines = rows()
    lines[index : index + 1] = [] if line is None else [line]
    return lines


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (replaced(40, None), r"no row for azimuth_deg = -150, elevation_deg = -80 \(1 of 703 directions\); add it"),
        (replaced(40, "-160,-80,0\n"), r"has the same direction as row 41 \(repeated directions: 1\); remove"),
        (replaced(40, "-150,-80,loud\n"), r"row 42, column 'gain_dbi': 'loud' is not a number"),
        (replaced(40, "-150,-80,\n"), r"has missing or non-finite values in 1 of 703 rows \(row 42\)"),
        (replaced(40, "-150,-80,-inf\n"), r"column 'gain_dbi' has missing or non-finite values"),
        (replaced(40, "-150,-80\n"), r"row 42: 2 cells, but the header has 3"),
        (replaced(40, "-150,-80,-300\n"), r"'gain_dbi': -300 must be -200 to 60 .*write a null as a low gain"),
        (replaced(40, "-150,-80,70\n"), r"'gain_dbi': 70 must be -200 to 60 .*check the unit"),
        (replaced(40, "-150,-100,0\n"), r"'elevation_deg': -100 must be -90 to 90 .*give degrees"),
        (replaced(40, "-190,-80,0\n"), r"'azimuth_deg': -190 must be -180 to 360"),
        (replaced(40, "-151,-80,0\n"), r"row \d+, column 'azimuth_deg': -151 follows -160 where .* steps are 10"),
        (replaced(36, "180,-90,2\n"), r"row 38, column 'gain_dbi': 2 differs from the gain at azimuth -180, 0"),
        (rows()[37:], r"elevation_deg runs from -80 to 90, but must run from -90 to 90"),
        ([line for line in rows() if int(line.split(",")[0]) <= 90], r"azimuth_deg runs from -180 to 90 in steps"),
        ([line for line in rows() if ",0,0" in line], r"column 'elevation_deg' contains only 0; give a grid"),
        ([line for line in rows() if ",0,0" in line or line[:2] == "0,"], r"no row for .*principal cuts alone"),
        ([line.replace(",0\n", ",12\n") for line in rows()], r"would radiate 15\.8 times the power that it accepts"),
        (
            [f"{a:g},{e:g},0\n" for a, e in product(range(-180, 181, 30), range(-90, 91, 30))],
            r"elevation_deg has steps of 30, but steps must be at most 15; give a finer grid",
        ),
        ([], r"contains no rows"),
    ],
)  # fmt: skip
def test_faults_are_reported_with_their_row_and_remedy(
    tmp_path: Path, lines: list[str], message: str
) -> None:
    file = tmp_path / "horn.csv"
    file.write_text(HEADER + "".join(lines))
    with pytest.raises(InputError, match=rf"horn\.csv.*{message}"):
        read_gain_table(file)


def test_the_file_without_faults_is_read(tmp_path: Path) -> None:
    (tmp_path / "horn.csv").write_text(HEADER + "".join(rows()))
    assert read_gain_table(tmp_path / "horn.csv").efficiency == 1.0


def test_a_missing_column_and_a_missing_file_are_reported(tmp_path: Path) -> None:
    (tmp_path / "horn.csv").write_text("azimuth_deg,elevation_deg,gain_db\n0,0,0\n")
    with pytest.raises(InputError, match="no column 'gain_dbi'; did you mean 'gain_db'"):
        read_gain_table(tmp_path / "horn.csv")
    with pytest.raises(InputError, match=r"absent\.csv: no such file"):
        cb.trace(
            "sionna:box", LINKS, frequency=FREQUENCY, tx_antenna={"pattern": str(tmp_path / "absent.csv")}
        )


# In a study


@pytest.fixture
def study(tmp_path: Path) -> Study:
    write_scene(tmp_path, {"wall": [[(0, -9, 0), (0, 9, 0), (0, 9, 9), (0, -9, 9)]]})
    (tmp_path / "links.csv").write_text("x,y,loss\n5,1,60\n6,2,61\n")
    (tmp_path / "horn.csv").write_text(HEADER + "".join(rows()))
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": FREQUENCY},
        "links": {"file": "links.csv", "tx": [9, 0, 3], "rx": ["x", "y", 2], "value": "loss"},
        "antennas": {"tx": {"pattern": "${HORN:-horn}.csv", "polarization": "H"}},
        "parameters": {"stone.relative_permittivity": {"bounds": [2, 9]}},
    }
    return Study.from_content(content, tmp_path / "study.toml")


def digests(study: Study) -> tuple[str, str]:
    """The digest of the trace and the fingerprint of a study's RT calls."""
    setup = study.opened()
    scene, links = setup.scene, setup.links
    trace = cache.trace_digest({}, scene, FREQUENCY, study.trace, study.antenna_pair, links)
    return trace, fingerprint(setup)


def test_the_file_is_found_relative_to_the_study_and_counts_by_its_content(
    study: Study, tmp_path: Path
) -> None:
    assert study.antenna_pair[0] == Antenna(str(tmp_path / "horn.csv"), "H")
    assert study.antenna_pair[1].gain_file is None
    before = digests(study)
    (tmp_path / "horn.csv").write_text(HEADER + "".join(reversed(rows())))
    assert digests(study) == before
    (tmp_path / "horn.csv").write_text(HEADER + "".join(replaced(40, "-150,-80,1\n")))
    changed = digests(study)
    assert changed[0] != before[0]
    assert changed[1] != before[1]


def test_an_external_program_gets_the_path_of_the_file(study: Study, tmp_path: Path) -> None:
    links = study.measurements()
    radio = RadioSettings(FREQUENCY, None, "power", study.antenna_pair)
    Request(radio, links.tx, links.rx).write(tmp_path / "request.json", "json")
    assert f'"pattern": "{tmp_path / "horn.csv"}"' in (tmp_path / "request.json").read_text()


def test_a_missing_file_of_a_study_is_reported(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (
        'version = 1\nscene = {file = "scene.xml", frequency = 4e9}\n'
        'links = {file = "links.csv", tx = [9, 0, 3], rx = ["x", "y", 2], value = "loss"}\n'
        'antennas = {rx = {pattern = "${HORN:-horn}.csv"}}\n'
        'parameters = {"stone.thickness" = {bounds = [0.1, 1]}}\n'
    )
    (tmp_path / "study.toml").write_text(text)
    assert Study.load(tmp_path / "study.toml").antenna_pair[1].gain_file == str(tmp_path / "horn.csv")
    monkeypatch.setenv("HORN", "dish")
    with pytest.raises(
        InputError, match=r"antennas\.rx\.pattern = '\$\{HORN:-horn\}\.csv': no such file, .*dish"
    ):
        Study.load(tmp_path / "study.toml")
