"""Ray tables: the paths of any engine, read with the surfaces of the scene, checked and corrected."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pandas as pd
import pytest

import calibray as cb
import two_ray
from calibray.engines.rays import table as ray_table
from calibray.engines.rays.compile import RaySetting, compile_rays
from calibray.engines.rays.table import RayTable, parse_rays, read_ray_file
from calibray.errors import InputError
from calibray.fields import path_gains, path_loss
from calibray.measurements import SourceTable
from calibray.paths import Kind, Paths, concatenate, take, take_links
from calibray.scenes import read_scene
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from small_scenes import CONCRETE, block, write_scene

FREQUENCY = 3.5e9
ANTENNAS = (Antenna("dipole"), Antenna("iso", "VH"))
LINKS = SimpleNamespace(
    tx=np.tile([-20.0, 2, 12], (4, 1)),
    rx=np.array([[-15.0, 4, 1.5], [12, 1, 2], [14, 9, 1.5], [0, 0, 2]]),
)
STONE = CONCRETE.replace("</bsdf>", '<float name="scattering_coefficient" value="0.3"/></bsdf>')


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Tracer:
    """A ground with two houses, traced with every kind of interaction."""
    ground = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    houses = {"house": block((-5, -5, 0), (5, 5, 8)), "other": block((-5, 15, 0), (25, 20, 9))}
    file = write_scene(tmp_path_factory.mktemp("yard"), {"ground": ground, **houses}, STONE)
    settings = TraceSettings(max_depth=2, samples=50_000, refraction=True, diffraction=True)
    return Tracer(read_scene(file, FREQUENCY), FREQUENCY, settings, *ANTENNAS)


@pytest.fixture(scope="module")
def traced(yard: Tracer) -> Paths:
    return yard.trace(LINKS)


@pytest.fixture
def rows(traced: Paths, tmp_path: Path) -> pd.DataFrame:
    cb.write_rays(traced, tmp_path / "rays.csv")
    return pd.read_csv(tmp_path / "rays.csv")


def powers(paths: Paths) -> np.ndarray:
    """Power of every path, summed over receive ports."""
    return (np.abs(path_gains(paths)) ** 2).sum(axis=(1, 2))


@pytest.mark.parametrize("ending", ["csv", "json", "h5", "parquet"])
def test_every_format_gives_the_paths_back(yard: Tracer, traced: Paths, tmp_path: Path, ending: str) -> None:
    """With the antennas known nothing is left to correct: surfaces, angles and edges are those of the tracer."""
    file = tmp_path / f"rays.{ending}"
    cb.write_rays(traced, file)
    read = cb.read_rays(file, yard.scene, frequency=FREQUENCY, antennas=ANTENNAS)
    assert {Kind.SPECULAR, Kind.REFRACTION, Kind.DIFFRACTION} == set(read.kind.tolist())
    np.testing.assert_array_equal(read.kind, traced.kind)
    np.testing.assert_allclose(powers(read), powers(traced), rtol=1e-6)
    # Vertices are in single precision, and Sionna's lengths of diffracted paths are off.
    smooth = np.array(
        [(traced.kind[a:b] != 8).all() for a, b in zip(traced.first, traced.first[1:], strict=False)]
    )
    np.testing.assert_allclose(read.correction[smooth], 1, atol=1e-4)
    np.testing.assert_allclose(read.correction, 1, atol=0.05)
    gains = [path_gains(replace(paths, correction=None))[smooth] for paths in (read, traced)]
    assert np.abs(gains[0] - gains[1]).max() < 1e-5 * np.abs(gains[1]).max()


def read(rows: pd.DataFrame, yard: Tracer, **arguments: object) -> Paths:
    return cb.read_rays(rows, yard.scene, frequency=FREQUENCY, **{"antennas": ANTENNAS, **arguments})


def test_the_order_of_rows_and_the_axes_do_not_matter(
    yard: Tracer, traced: Paths, rows: pd.DataFrame
) -> None:
    shuffled = rows.sample(frac=1, random_state=3)
    np.testing.assert_array_equal(path_loss(read(shuffled, yard)), path_loss(read(rows, yard)))
    upright = rows.assign(y=rows.z, z=-rows.y)
    np.testing.assert_allclose(path_loss(read(upright, yard, axes="x -z y")), path_loss(traced), atol=1e-5)
    with pytest.raises(
        InputError, match=r"lies .* m from the nearest surface.*order and signs of x, y and z"
    ):
        read(upright, yard)


def test_materials_are_those_of_the_faces_unless_stated(yard: Tracer, rows: pd.DataFrame) -> None:
    bare = rows.drop(columns="material")
    np.testing.assert_array_equal(read(bare, yard).material, read(rows, yard).material)
    ground = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    twice = write_scene(yard.scene.path.parent / "twice", {"a": ground, "b": ground})
    scene = read_scene(twice, FREQUENCY, split={"paved": "b"})
    reflected = pd.DataFrame(
        {
            "path": 1, "point": [0, 1, 2], "type": ["transmitter", "reflection", "receiver"], "x": [0.0, 5, 10],
            "y": 0.0, "z": [10.0, 0, 10],
        }
    )  # fmt: skip
    with pytest.raises(InputError, match="'stone' and 'paved' coincide at this point; state the material"):
        cb.read_rays(reflected, scene, frequency=FREQUENCY)
    for column, value in (("material", "paved"), ("object", "b")):
        stated = cb.read_rays(reflected.assign(**{column: value}), scene, frequency=FREQUENCY)
        assert stated.material.tolist() == [1]
    with pytest.raises(InputError, match="no object 'c'"):
        cb.read_rays(reflected.assign(object="c"), scene, frequency=FREQUENCY)


@pytest.mark.parametrize("ending", ["csv", "json", "h5", "parquet"])
def test_the_name_of_a_material_may_be_a_number(tmp_path: Path, ending: str) -> None:
    ground = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    file = write_scene(tmp_path, {"a": ground, "b": [[(x, y, 50.0) for x, y, _ in ground[0]]]})
    scene = read_scene(file, FREQUENCY, split={"7": "a"})
    reflected = pd.DataFrame(
        {
            "path": 1, "point": [0, 1, 2], "type": ["transmitter", "reflection", "receiver"], "x": [0.0, 5, 10],
            "y": 0.0, "z": [10.0, 0, 10],
        }
    )  # fmt: skip
    paths = cb.read_rays(reflected, scene, frequency=FREQUENCY)
    cb.write_rays(paths, tmp_path / f"rays.{ending}")
    read_back = cb.read_rays(tmp_path / f"rays.{ending}", scene, frequency=FREQUENCY)
    assert list(scene.materials)[read_back.material[0]] == "7"


def test_an_edge_where_two_houses_meet_has_the_stated_material(tmp_path: Path) -> None:
    """The eaves of two houses of different materials continue each other; the ray bends where they meet."""
    houses = {"a": block((0, 0, 0), (10, 10, 8)), "b": block((0, 10, 0), (10, 20, 8))}
    scene = read_scene(write_scene(tmp_path, houses), FREQUENCY, split={"other": "b"})
    bent = pd.DataFrame(
        {
            "path": 0, "point": [0, 1, 2], "type": ["transmitter", "diffraction", "receiver"], "x": [-10.0, 0, 15],
            "y": 10.0, "z": [6.0, 8, 14], "power_db": -100.0,
        }
    )  # fmt: skip
    with pytest.raises(InputError, match="'stone' and 'other' coincide at this point; state the material"):
        cb.read_rays(bent, scene, frequency=FREQUENCY)
    for column, value, expected in (("material", "stone", 0), ("material", "other", 1), ("object", "b", 1)):
        stated = cb.read_rays(bent.assign(**{column: ["", value, ""]}), scene, frequency=FREQUENCY)
        assert stated.material.tolist() == [expected]


WRONG = {
    "points of the path missing": (lambda t: t.drop(t.index[t.point == 3][0] - 1), "increase by 1"),
    "a receiver missing": (lambda t: t[t.type != "receiver"], "and the last point the receiver"),
    "an unknown type": (lambda t: t.replace({"type": {"reflection": "R"}}), "'R'"),
    "an unknown material": (
        lambda t: t.assign(material="wood"),
        "no material 'wood'.* without the column material",
    ),
    "two powers of a path": (
        lambda t: t.assign(power_db=t.power_db - t.point),
        "must state the same power_db",
    ),
    "path loss in place of gain": (lambda t: t.assign(power_db=-t.power_db), "path gain is negative"),
    "amplitudes in microvolts": (
        lambda t: t.drop(columns="power_db").assign(
            gain_real=np.where(t.path == 1, 40.0, 1e-9), gain_imag=0.0
        ),
        "the magnitude 40; it must be at most 1",
    ),
    "received power in dBm": (lambda t: t.assign(power_db=t.power_db + 30), "30.0 dB above free space"),
    "delays in nanoseconds": (lambda t: t.assign(delay=t.delay * 1e9), "give the total delay in seconds"),
    "relative delays": (lambda t: t.assign(delay=t.delay - t.delay.min()), "not relative to the first path"),
    "positions in degrees": (lambda t: t.assign(x=t.x / 111e3, y=t.y / 111e3), "check the units"),
    "a bent transmission": (lambda t: t.replace({"type": {"reflection": "transmission"}}), "bends by"),
    "a straight reflection": (
        lambda t: t.replace({"type": {"transmission": "reflection"}}),
        "law of reflection",
    ),
    "no diffracting edge": (
        lambda t: t.replace({"type": {"reflection": "diffraction"}}),
        "no edge of the scene",
    ),
    "a column of power in other units": (
        lambda t: t.rename(columns={"power_db": "power_dbm"}),
        "did you mean 'power_db'",
    ),
    "a column of path gain": (
        lambda t: t.rename(columns={"power_db": "path_gain_db"}),
        "did you mean 'power_db'",
    ),
    "one column of complex gain": (
        lambda t: t.drop(columns="power_db").assign(gain=1e-4j),
        "'gain' .*did you mean 'power_db'",
    ),
    "a column of delay with its unit": (
        lambda t: t.rename(columns={"delay": "delay_s"}),
        "did you mean 'delay'",
    ),
    "a column of materials": (
        lambda t: t.rename(columns={"material": "materials"}),
        "did you mean 'material'",
    ),
    "a misspelt column": (lambda t: t.rename(columns={"link": "lnk"}), "'lnk' .*did you mean 'link'"),
    "a column twice": (lambda t: t.assign(**{" Path": t.path}), "2 columns 'path'; keep one"),
    "a path without power": (
        lambda t: t.assign(power_db=t.power_db.where(t.path != 3)),
        r"path 3 states no power_db; add it, or -inf \(-10000 in JSON\) for a path without power",
    ),
    "a path without delay": (
        lambda t: t.assign(delay=t.delay.where(t.path != 3)),
        "path 3 states no delay; add it, or remove the column",
    ),
    "a path without link": (
        lambda t: t.assign(link=t.link.where(t.path != 3)),
        "path 3 states no link; add it",
    ),
    "numbers that restart in every link": (
        lambda t: t.assign(path=t.path - t.groupby("link").path.transform("min")),
        "several paths have the number 0 .*unique in the table",
    ),
    "no rows": (lambda t: t.iloc[:0], "contains no rows"),
    "nothing": (lambda t: None, "is a NoneType; it must be a DataFrame"),
    "a list": (lambda t: t.path.tolist(), "is a list; it must be a DataFrame"),
    "a vertex off the surface": (lambda t: t.assign(z=t.z + 0.05 * (t.type == "reflection")), "lies 0.05 m"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_wrong_table_is_refused(yard: Tracer, rows: pd.DataFrame, fault: str) -> None:
    change, message = WRONG[fault]
    with pytest.raises(InputError, match=message):
        read(change(rows), yard)


def test_letter_case_and_blanks_of_names_and_types_do_not_matter(
    yard: Tracer, traced: Paths, rows: pd.DataFrame
) -> None:
    loud = rows.rename(columns=lambda name: f" {name.upper()}")
    loud[" TYPE"] = [f" {name.capitalize()} " for name in rows.type]
    np.testing.assert_array_equal(read(loud, yard).kind, traced.kind)
    np.testing.assert_array_equal(path_loss(read(loud, yard)), path_loss(read(rows, yard)))


@pytest.mark.parametrize(
    ("name", "meant"),
    [(name, "power_db") for name in ("received power (dBm)", "path loss [dB]", "pl_db", "prx_dbm", "rx_power", "rssi",
     "channel_gain_db", "a_db", "amplitude", "magnitude_db")] + [("h_re", "gain_real"), ("Excess-Delay", "delay")],
)  # fmt: skip
def test_a_quantity_is_recognised_anywhere_in_the_name_of_a_column(name: str, meant: str) -> None:
    with pytest.raises(InputError, match=f"did you mean '{meant}'"):
        RayTable.of(SourceTable(direct_paths(["1"]).rename(columns={"power_db": name})))


def test_blanks_and_brackets_of_names_count_as_underscores() -> None:
    table = direct_paths(["1"])
    renamed = RayTable.of(SourceTable(table.rename(columns={"power_db": "Power [dB]"})))
    assert renamed.power == RayTable.of(SourceTable(table)).power


@pytest.mark.parametrize(
    ("antennas", "assumed"), [(None, "isotropic antennas of both"), (ANTENNAS, "the stated")]
)
def test_a_table_without_powers_is_announced(yard: Tracer, caplog, antennas, assumed: str) -> None:
    read(direct_paths(["1"]).drop(columns="power_db"), yard, antennas=antennas)
    assert (
        f"states no power for its paths, so path loss is computed with the materials of the scene and {assumed}"
        in (caplog.text)
    )


def test_columns_that_resemble_no_absent_one_are_ignored(yard: Tracer, rows: pd.DataFrame) -> None:
    more = rows.assign(power_dbm=7.0, delay_spread=1.0, material_id=3, line="a", phase=0.0)
    np.testing.assert_array_equal(path_loss(read(more, yard)), path_loss(read(rows, yard)))


def test_a_dictionary_of_columns_is_a_table_and_paths_are_not(
    yard: Tracer, traced: Paths, rows: pd.DataFrame
) -> None:
    columns = {name: rows[name].tolist() for name in rows}
    np.testing.assert_array_equal(path_loss(read(columns, yard)), path_loss(read(rows, yard)))
    with pytest.raises(InputError, match="not a ray table"):
        read(columns | {"x": [1.0]}, yard)
    with pytest.raises(InputError, match="already"):
        read(traced, yard)


@pytest.mark.parametrize("paths", ["rays.csv", None])
def test_only_paths_are_written(paths: object, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"write_rays: paths is .*, must be Paths"):
        cb.write_rays(paths, tmp_path / "rays.csv")


def test_a_response_that_is_not_a_table_names_the_format(rows: pd.DataFrame, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"begins with 'path,.*it must be JSON or HDF5, not CSV"):
        parse_rays(rows.to_csv(index=False).encode(), "the response")
    with h5py.File(tmp_path / "grouped.h5", "w") as content:
        content["rays/path"] = rows.path.to_numpy()
    with pytest.raises(InputError, match="must be at the root of the file; found group 'rays'"):
        parse_rays((tmp_path / "grouped.h5").read_bytes(), "the response")


def test_the_correction_takes_the_power_of_the_engine(
    yard: Tracer, traced: Paths, rows: pd.DataFrame
) -> None:
    """The engine's antennas are unknown to the reader; at its materials every path has its power."""
    paths = read(rows, yard, antennas=None)
    np.testing.assert_allclose(powers(paths).sum() / paths.tx_field.shape[1], powers(traced).sum(), rtol=1e-6)
    np.testing.assert_allclose(path_loss(paths), path_loss(traced), atol=1e-6)
    loud = read(rows.assign(power_db=rows.power_db + 7), yard, antennas=None)
    np.testing.assert_allclose(path_loss(loud), path_loss(traced) - 7, atol=1e-6)
    ratio = loud.correction / paths.correction
    np.testing.assert_allclose(ratio, 10**0.7)


@pytest.mark.parametrize("form", ["level", "gain"])
def test_a_path_of_power_zero_is_absent(yard: Tracer, rows: pd.DataFrame, form: str) -> None:
    weakest = rows.path == rows.path[rows.power_db.idxmin()]
    if form == "level":
        silent = rows.assign(power_db=rows.power_db.where(~weakest, -np.inf))
        silence = rows.assign(power_db=-np.inf)
    else:
        gain = 10 ** (rows.power_db / 20)
        silent = rows.drop(columns="power_db").assign(gain_real=gain.where(~weakest, 0), gain_imag=0.0)
        silence = silent.assign(gain_real=0.0)
    paths = read(silent, yard)
    assert paths.num_paths == rows.path.nunique() - 1
    np.testing.assert_allclose(path_loss(paths), path_loss(read(rows[~weakest], yard)), rtol=1e-12)
    with pytest.raises(InputError, match="no path has a power above 0"):
        read(silence, yard)


@pytest.mark.parametrize("in_study", [False, True])
def test_a_link_whose_paths_have_no_power_remains(yard: Tracer, in_study: bool) -> None:
    rows = direct_paths([f"rx{number}" for number in (1, 2, 3)])
    silent = rows.assign(power_db=rows.power_db.where(rows.link != "rx2", -np.inf))
    ends = [rows[rows.type == end][["x", "y", "z"]].to_numpy() for end in ("transmitter", "receiver")]
    links = SimpleNamespace(tx=ends[0], rx=ends[1]) if in_study else None
    paths = compile_rays(RayTable.of(SourceTable(silent)), RaySetting(yard.scene, FREQUENCY, links=links))
    loss = -rows.power_db.to_numpy()[::2]
    np.testing.assert_allclose(path_loss(paths), [loss[0], np.inf, loss[2]], rtol=1e-12)


@pytest.mark.parametrize("ending", ["csv", "json", "h5", "parquet"])
def test_links_without_power_are_written_with_the_others(
    yard: Tracer, traced: Paths, tmp_path: Path, ending: str
) -> None:
    """Otherwise, the path loss of later links would be compared with measurements of earlier ones."""
    paths = take(traced, traced.link != 1)
    paths = replace(paths, tx_field=np.where((paths.link == 2)[:, None, None], 0, paths.tx_field))
    expected = np.where(np.isin(range(4), [1, 2]), np.inf, path_loss(traced))
    cb.write_rays(paths, tmp_path / f"rays.{ending}")
    np.testing.assert_allclose(path_loss(read(tmp_path / f"rays.{ending}", yard)), expected, rtol=1e-6)
    if ending == "json":  # other programs refuse "-Infinity"
        json.loads((tmp_path / "rays.json").read_text(), parse_constant=pytest.fail)


@pytest.mark.parametrize("height", [22.0, 18.0])
def test_a_null_of_the_antennas_has_the_power_of_a_rounding_error(yard: Tracer, height: float) -> None:
    """A short dipole radiates nothing along its axis; a program in single precision states some power, or none."""
    rows = direct_paths(["aside", "zenith"])
    rows.loc[3, ["y", "z"]] = 0.0, height
    level = np.where(rows.link == "aside", rows.power_db + 20 * np.log10(1.5**0.5), -200.0)
    paths = read(rows.assign(power_db=level), yard, antennas=(Antenna("dipole"), Antenna()))
    np.testing.assert_allclose(path_loss(paths), [-level[0], np.inf])
    for error_db in (80.0, rows.power_db - level - 119.5):
        with pytest.raises(InputError, match="dB above free space with the stated antennas"):
            read(
                rows.assign(power_db=level + error_db * (rows.link == "zenith")),
                yard,
                antennas=(Antenna("dipole"), Antenna()),
            )


def test_every_diffraction_of_a_path_has_its_own_edge(tmp_path: Path) -> None:
    """Over the roofs of two houses, as in exports of Wireless InSite; each edge is the source for the next."""
    houses = {"low": block((-5, -5, 0), (0, 5, 8)), "high": block((10, -5, 0), (15, 5, 9))}
    scene = read_scene(write_scene(tmp_path, houses), FREQUENCY)
    stops = np.array([[-20.0, 0, 12], [0, 0, 8], [10, 0, 9], [30, 0, 9.5]])
    kinds = ["transmitter", "diffraction", "diffraction", "receiver"]
    rows = pd.DataFrame(stops, columns=list("xyz")).assign(path=1, point=range(4), type=kinds)
    paths = cb.read_rays(rows, scene, frequency=FREQUENCY, antennas=(Antenna(), Antenna()))
    table, (a, b, c) = paths.diffraction, np.linalg.norm(np.diff(stops, axis=0), axis=1)
    np.testing.assert_allclose(table.exterior_angle, 1.5 * np.pi)
    np.testing.assert_allclose(table.distance, [a * b / (a + b), (a + b) * c / (a + b + c)])
    # The angles of both rays with the lit face: the roof of the low house, the wall of the high one.
    np.testing.assert_allclose(table.azimuth_in, [np.arctan2(4, 20), np.arctan2(10, 1)])
    # A wave of amplitude 1 / a that every edge spreads by sqrt(s' / (s (s' + s))).
    spreading = np.sqrt(a / (b * (a + b))) * np.sqrt((a + b) / (c * (a + b + c))) / a
    np.testing.assert_allclose(paths.spreading, spreading)


def direct_paths(labels: list[str]) -> pd.DataFrame:
    """Direct paths of 1, 2, 3, ... m, one for each link, with their power in free space."""
    number = np.repeat(np.arange(1, len(labels) + 1), 2)
    point = np.tile([0, 1], len(labels))
    return pd.DataFrame(
        {
            "path": number, "point": point, "type": np.array(["transmitter", "receiver"])[point], "x": -30.0,
            "y": 1.0 * number * point, "z": 20.0, "link": np.repeat(labels, 2),
            "power_db": -20 * np.log10(4 * np.pi * number * FREQUENCY / 299_792_458),
        }
    )  # fmt: skip


@pytest.mark.parametrize("form", ["1-{}", "rx{}", "rx0{}"])
def test_numbers_within_names_order_the_links(yard: Tracer, form: str) -> None:
    """The names of `rays_to_table.m` are such as 1-2 and 1-10, and the tenth receiver is not the second link."""
    labels = [form.format(number) for number in range(1, 13)]
    paths = read(direct_paths(labels), yard, antennas=None)
    np.testing.assert_allclose(paths.rx_position[:, 1], np.arange(1, 13))


def test_long_numbers_of_paths_remain_distinct(yard: Tracer) -> None:
    """In double precision, the first two would be the same number."""
    rows = direct_paths(["a", "b", "c"])
    for first in (2**53, 2**63):
        number = np.repeat(np.arange(first, first + 3, dtype=np.uint64), 2)
        assert read(rows.assign(path=number, link=number), yard, antennas=None).num_links == 3


@pytest.mark.parametrize("level_db", [-1000.0, -450.0])
def test_paths_of_any_power_can_be_loaded_again(yard: Tracer, tmp_path: Path, level_db: float) -> None:
    rows = direct_paths(["a", "b"])
    paths = read(rows.assign(power_db=rows.power_db.where(rows.link == "a", level_db)), yard, antennas=None)
    paths.save(tmp_path / "paths.h5")
    np.testing.assert_allclose(path_loss(Paths.load(tmp_path / "paths.h5"))[1], -level_db)


def test_a_correction_is_stored_and_follows_its_path(
    yard: Tracer, rows: pd.DataFrame, tmp_path: Path
) -> None:
    paths = read(rows, yard, antennas=None)
    paths.save(tmp_path / "paths.h5")
    np.testing.assert_array_equal(Paths.load(tmp_path / "paths.h5").correction, paths.correction)
    index = np.arange(paths.num_paths)[::-2]
    np.testing.assert_array_equal(take(paths, index).correction, paths.correction[index])
    assert take_links(paths, np.array([1, 1])).correction.shape == (2 * (paths.link == 1).sum(),)
    joined = concatenate([paths, replace(paths, correction=None)])
    assert sorted(joined.correction) == sorted([*paths.correction, *np.ones(paths.num_paths)])
    assert concatenate([replace(paths, correction=None)]).correction is None


def test_diffuse_paths_need_their_power(yard: Tracer) -> None:
    settings = TraceSettings(max_depth=1, samples=2000, diffuse_reflection=True)
    scattered = yard.with_settings(settings).trace(LINKS)
    cb.write_rays(scattered, yard.scene.path.parent / "diffuse.csv")
    table = pd.read_csv(yard.scene.path.parent / "diffuse.csv")
    assert (table.type == "diffuse").sum() > 20
    stone = yard.scene.materials["stone"]
    changed = {"stone": replace(stone, relative_permittivity=9.0, scattering_coefficient=0.6)}
    np.testing.assert_allclose(
        path_loss(read(table, yard), changed), path_loss(scattered, changed), atol=1e-4
    )
    with pytest.raises(InputError, match="require the power of the path"):
        read(table.drop(columns="power_db"), yard)


def test_positions_that_nearly_agree_are_one_link(yard: Tracer, rows: pd.DataFrame) -> None:
    """At a rounding boundary, too: of paths that end at 1.5005 m +- 0.01 mm, half round up and half down."""
    table = rows.drop(columns=["link", "delay"])
    ends = (table.type == "receiver") & (table.z == 1.5)
    table.loc[ends, "z"] += 0.0005 + 1e-5 * (-1.0) ** np.arange(ends.sum())
    assert read(table, yard).num_links == read(rows, yard).num_links


def test_paths_of_a_study_belong_to_its_links(tmp_path: Path) -> None:
    study = two_ray.study(tmp_path, links=8)
    setup = cb.Setup.open(study, tracer=two_ray.TwoRay)
    traced = setup.trace()
    cb.write_rays(traced, tmp_path / "rays.csv")
    rows = pd.read_csv(tmp_path / "rays.csv").drop(columns="link")
    paths = cb.read_rays(rows[rows.path != 3], study)
    assert paths.num_links == 8
    assert np.bincount(paths.link).tolist() == [2, 1, 2, 2, 2, 2, 2, 2]
    np.testing.assert_allclose(path_loss(paths)[2:], path_loss(traced)[2:], atol=1e-5)
    moved = rows.assign(z=rows.z + 0.5 * (rows.type == "receiver"))
    with pytest.raises(InputError, match=r"does not connect the positions of a link.* 0\.5 m away"):
        cb.read_rays(moved[moved.path % 2 == 0].assign(delay=np.nan).drop(columns="delay"), study)


@pytest.mark.parametrize("form", ["whole numbers", "floats", "one number per path"])
def test_links_are_in_the_order_of_their_numbers(yard: Tracer, form: str) -> None:
    """MATLAB writes numbers as doubles, and pandas reads a column with empty cells as such."""
    number = np.arange(1, 13)
    link = np.repeat(number, 2)
    rows = pd.DataFrame(
        {
            "path": link, "point": np.tile([0, 1], 12), "type": ["transmitter", "receiver"] * 12, "x": -30.0,
            "y": np.stack([0 * number, number], axis=1).ravel(), "z": 20.0,
            "link": np.where(np.arange(24) % 2, link, np.nan) if form == "one number per path" else link,
        }
    )  # fmt: skip
    rows = rows.astype({"path": float, "link": float}) if form == "floats" else rows
    paths = read(rows, yard, antennas=(Antenna(), Antenna()))
    np.testing.assert_allclose(np.linalg.norm(paths.rx_position - paths.tx_position, axis=1), number)


def test_a_path_that_comes_twice_is_refused(yard: Tracer, rows: pd.DataFrame) -> None:
    """As in merged exports, which would double its power."""
    twice = pd.concat([rows, rows[rows.path == 2].assign(path=1000)])
    with pytest.raises(
        InputError, match=r"paths 2 and 1000 have the same points and types \(repeated paths: 1 of \d+"
    ):
        read(twice, yard)


def test_an_offset_of_all_direct_paths_is_named(yard: Tracer, rows: pd.DataFrame, caplog) -> None:
    weaker = rows.assign(power_db=rows.power_db - 12)
    with pytest.raises(
        InputError, match=r"12\.0 dB below free space .*all direct paths differ by about this"
    ):
        read(weaker, yard)
    one = int(rows.path[rows.type == "reflection"].iloc[0])
    direct = rows.groupby("path").point.transform("max") == 1
    number = int(rows.path[direct].iloc[0])
    with pytest.raises(InputError, match=rf"path {number}, a direct path, is 12\.0 dB below"):
        read(rows.assign(power_db=rows.power_db - 12 * (rows.path == number) - 90 * (rows.path == one)), yard)
    read(rows, yard, antennas=None)
    assert not caplog.records
    read(rows.assign(power_db=rows.power_db + 30), yard, antennas=None)  # dBm
    assert "check that power_db is the path gain, not received power" in caplog.text
    read(rows.assign(power_db=2 * rows.power_db), yard, antennas=None)
    assert "below free space between isotropic antennas (median): check that power_db is the" in caplog.text


def test_antennas_of_a_study_are_those_of_the_table(tmp_path: Path) -> None:
    study = two_ray.study(tmp_path, links=8)
    cb.write_rays(cb.Setup.open(study, tracer=two_ray.TwoRay).trace(), tmp_path / "rays.csv")
    np.testing.assert_allclose(cb.read_rays(tmp_path / "rays.csv", study).correction, 1, atol=1e-4)
    bare = two_ray.study(tmp_path, links=8, antennas={})
    assert np.abs(cb.read_rays(tmp_path / "rays.csv", bare).correction - 1).max() > 0.1
    isotropic = {end: {"pattern": "iso", "polarization": "V"} for end in ("tx", "rx")}
    for known, expected in ((None, False), (True, True), (False, False)):
        antennas = isotropic if known is None else isotropic | {"known": known}
        setup = cb.Setup.open(two_ray.study(tmp_path, links=8, antennas=antennas), tracer=two_ray.TwoRay)
        assert (setup.known_antennas is not None) == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frequency": "3.5e9"}, "frequency = '3.5e9': must be from 1e"),
        ({"frequency": 3.5}, "frequency = 3.5: must be from 1e"),
        ({"antennas": ("iso", "iso")}, "must be two Antenna"),
        ({"tx_power_dbm": 30.0}, "applies only to Wireless InSite files"),
    ],
)
def test_arguments_that_do_not_go_with_a_table_are_refused(
    yard: Tracer, rows: pd.DataFrame, arguments: dict, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        cb.read_rays(rows, yard.scene, **{"frequency": FREQUENCY, **arguments})


def test_a_table_goes_with_one_carrier(tmp_path: Path) -> None:
    study = two_ray.study(tmp_path, links=8)
    content = study.content()
    content["links"]["frequency"] = "frequency"
    links = pd.read_csv(tmp_path / content["links"]["file"])
    links.assign(frequency=content["scene"]["frequency"]).to_csv(
        tmp_path / content["links"]["file"], index=False
    )
    cb.write_rays(cb.Setup.open(study, tracer=two_ray.TwoRay).trace(), tmp_path / "rays.csv")
    with pytest.raises(InputError, match="powers at one carrier"):
        cb.read_rays(tmp_path / "rays.csv", cb.Study.from_content(content, study.path))
    with pytest.raises(InputError, match=r"engine\.rays with links\.frequency"):
        cb.Study.from_content(content | {"engine": {"name": "replay", "rays": "rays.csv"}}, study.path)


def test_rays_of_a_study_with_antennas_per_link_keep_their_powers(tmp_path: Path) -> None:
    """Direct paths 15 dB above those of isotropic antennas: the table contains the antennas, whichever they are."""
    study = two_ray.study(tmp_path, links=8)
    cb.write_rays(cb.Setup.open(study, tracer=two_ray.TwoRay).trace(), tmp_path / "rays.csv")
    rows = pd.read_csv(tmp_path / "rays.csv").assign(power_db=lambda table: table.power_db + 15)
    content = study.content()
    content["antennas"]["tx"] = {"pattern": "tr38901", "polarization": "V"}
    content["links"]["tx_antenna"] = {"aim": "other end"}
    paths = cb.read_rays(rows, cb.Study.from_content(content, study.path))
    power = 10 ** (rows[rows.type == "receiver"].set_index("link").power_db / 10)
    np.testing.assert_allclose(path_loss(paths), -10 * np.log10(power.groupby("link").sum()), atol=1e-4)


def test_a_study_replays_the_rays_of_another_engine(tmp_path: Path) -> None:
    """Nothing is traced: the table has the paths of all links, and of those that are predicted."""
    traced = cb.Setup.open(two_ray.study(tmp_path), tracer=two_ray.TwoRay).trace()
    cb.write_rays(traced, tmp_path / "rays.parquet")
    (tmp_path / two_ray.TRACED).unlink(missing_ok=True)
    study = two_ray.study(tmp_path, engine={"name": "replay", "rays": "rays.parquet"})
    assert tmp_path / "rays.parquet" in study.files()
    setup = cb.Setup.open(study, tracer=two_ray.TwoRay)
    engine = cb.engines.make(setup)
    modelled = engine.path_loss(np.array([[two_ray.TRUTH]]))[0]
    np.testing.assert_allclose(modelled, setup.links.path_loss_db, atol=1e-4)
    assert np.abs(engine.path_loss(setup.parameters.start[None])[0] - modelled).max() > 1
    some = setup.at(setup.links.select(np.arange(len(modelled)) > 25))
    np.testing.assert_allclose(
        path_loss(some.trace(), combining="coherent"), path_loss(traced, combining="coherent")[26:], atol=1e-4
    )
    assert not (tmp_path / two_ray.TRACED).exists()
    (tmp_path / "rays.parquet").unlink()
    with pytest.raises(InputError, match=r"engine\.rays = 'rays\.parquet': no such file.*without engine"):
        cb.Study.from_content(study.content(), study.path).check_files()


def test_files_that_would_fill_the_memory_or_lie_elsewhere_are_refused(
    traced: Paths, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    columns = ("path", "point", "type", "x", "y", "z")
    with h5py.File(tmp_path / "large.h5", "w") as content:
        for name in columns:
            content.create_dataset(name, (10**13,), chunks=(2**20,), dtype="f8", compression="gzip")
    with pytest.raises(InputError, match=r"large\.h5: has 457,763,672 MiB; it must have at most 1024"):
        read_ray_file(tmp_path / "large.h5")
    cb.write_rays(traced, tmp_path / "rays.h5")
    with h5py.File(tmp_path / "linked.h5", "w") as content:
        for name in columns:
            content[name] = h5py.ExternalLink("rays.h5", name)
    with pytest.raises(InputError, match="no rows"):
        read_ray_file(tmp_path / "linked.h5")
    (tmp_path / "deep.json").write_text("[" * 10**6)
    with pytest.raises(InputError, match="not a ray table"):
        read_ray_file(tmp_path / "deep.json")
    monkeypatch.setattr(ray_table, "LARGEST_JSON", 100)
    cb.write_rays(traced, tmp_path / "rays.json")
    with pytest.raises(InputError, match="MiB of JSON"):
        read_ray_file(tmp_path / "rays.json")


def test_paths_of_a_link_with_other_ends_are_refused_although_the_study_has_the_link(
    yard: Tracer, traced: Paths, rows: pd.DataFrame
) -> None:
    """Left out, the link would lack their power."""
    first = rows["path"] == rows["path"][0]
    rows.loc[first & (rows["type"] == "transmitter"), "z"] += 100.0
    with pytest.raises(InputError, match="not have the same ends as the other paths of its link"):
        compile_rays(RayTable.of(SourceTable(rows)), RaySetting(yard.scene, FREQUENCY, None, LINKS))
