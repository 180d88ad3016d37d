"""Paths of other programs: each format holds Sionna RT's own paths, and their power comes back."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from copy import copy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sionna.rt as rt
from scipy.io import loadmat, savemat

import calibray as cb
from calibray.engines.rays.compile import powers
from calibray.engines.rays.other_programs import Polyline, check_carrier, read_sionna_paths, rows_of
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.paths import Paths
from calibray.tracing.settings import Antenna

SCENE = "sionna:simple_street_canyon"
FREQUENCY = 3.5e9
MATLAB = Path(__file__).parents[2] / "examples" / "matlab"
TX_POWER_DBM = 13.0


@pytest.fixture(scope="module")
def paths() -> rt.Paths:
    scene = rt.load_scene(rt.scene.simple_street_canyon)
    scene.frequency = FREQUENCY
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="tr38901", polarization="V")
    scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="VH")
    scene.add(rt.Transmitter("tx", position=[-30, 0, 10]))
    for number, x in enumerate((-20.0, 0.0, 25.0)):
        scene.add(rt.Receiver(f"rx{number}", position=[x, 3.0, 1.5]))
    return rt.PathSolver()(scene, max_depth=2, samples_per_src=20_000, refraction=False)


@pytest.fixture(scope="module")
def lines(paths: rt.Paths) -> list[Polyline]:
    """The paths as points and types."""
    frame = read_sionna_paths(paths).frame
    return [
        Polyline(
            rows[["x", "y", "z"]].to_numpy(),
            rows.type.tolist()[1:-1],
            rows.power_db.iloc[0],
            rows.delay.iloc[0],
        )
        for _, rows in frame.groupby("path")
    ]


def by_receiver(lines: list[Polyline]) -> list[list[Polyline]]:
    ends = sorted({tuple(line.points[-1]) for line in lines})
    return [[line for line in lines if tuple(line.points[-1]) == end] for end in ends]


def read(source: object, **arguments: object) -> Paths:
    return cb.read_rays(source, SCENE, frequency=FREQUENCY, **arguments)


def test_paths_of_sionna_have_its_powers(paths: rt.Paths) -> None:
    real, imaginary = (np.array(part, dtype=float) for part in paths.a)
    power = (real**2 + imaginary**2).sum(axis=(1, 3))[:, 0]
    program = read(paths)
    assert program.num_paths == (power > 0).sum() > 10
    for rx in range(3):
        mine = np.sort(
            powers(program)[
                np.abs(program.rx_position[program.link] - [[-20.0, 0.0, 25.0][rx], 3, 1.5]).max(axis=1)
                < 0.01
            ]
        )
        np.testing.assert_allclose(mine, np.sort(power[rx][power[rx] > 0]), rtol=1e-6)


def test_antennas_of_orthogonal_polarization_receive_the_power_of_rounding_errors() -> None:
    """Of the direct path, and of reflections in the plane of incidence: in closed form, they have no power."""
    scene = rt.load_scene(rt.scene.simple_street_canyon)
    scene.frequency = FREQUENCY
    for end, polarization in (("tx", "V"), ("rx", "H")):
        array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization=polarization)
        setattr(scene, f"{end}_array", array)
    scene.add(rt.Transmitter("tx", [-33.0, 0.0, 20.0]))
    scene.add(rt.Receiver("rx", [-29.0, 4.0, 1.5]))
    crossed = rt.PathSolver()(scene, max_depth=2, refraction=False)
    power = sum(np.array(part, dtype=float) ** 2 for part in crossed.a).sum()
    program = read(crossed, antennas=(Antenna(), Antenna(polarization="H")))
    np.testing.assert_allclose(path_loss(program), -10 * np.log10(power), atol=1e-4)


def test_surfaces_that_coincide_have_the_material_that_sionna_hit() -> None:
    """A wave is transmitted through the common wall of two buildings of different materials."""
    scene = rt.load_scene(rt.scene.simple_street_canyon)
    scene.frequency = FREQUENCY
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Transmitter("tx", [-30.0, 0.0, 10.0]))
    for number, x in enumerate((-20.0, 0.0, 25.0, 40.0)):
        scene.add(rt.Receiver(f"rx{number}", [x, 3.0 if x < 30 else -2.0, 1.5]))
    scene.add(rt.Receiver("rx4", [-44.0, 30.0, 1.5]))
    refracted = rt.PathSolver()(scene, max_depth=2, samples_per_src=20_000)
    rows = read_sionna_paths(refracted)
    with pytest.raises(InputError, match="coincide at this point; state the material"):
        read(rows.frame.drop(columns="hit_material"))
    assert read(refracted).num_paths > 20
    assert {"concrete", "marble"} <= set(rows.frame.hit_material.dropna())


def test_a_gain_of_sionna_that_is_not_a_number_is_refused(paths: rt.Paths) -> None:
    """Otherwise, the link would silently lose the path."""
    real, imaginary = (np.array(part) for part in paths.a)
    real[np.unravel_index(np.argmax(np.abs(real)), real.shape)] = np.nan
    spoilt = copy(paths)
    spoilt._a_real, spoilt._a_imag = real, imaginary
    with pytest.raises(InputError, match=r"the power of path .* is NaN"):
        read(spoilt)


def test_arrays_of_several_places_are_refused() -> None:
    scene = rt.load_scene(rt.scene.simple_street_canyon)
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=2, pattern="iso", polarization="V")
    scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Transmitter("tx", position=[0, 0, 10]))
    scene.add(rt.Receiver("rx", position=[5, 0, 2]))
    found = rt.PathSolver()(scene, max_depth=0, samples_per_src=100)
    with pytest.raises(InputError, match="2 antennas, whose paths are summed"):
        read(found)


def write_insite(lines: list[Polyline], folder: Path, phase: str = "31.9 ") -> Path:
    letters = {"reflection": "R", "diffraction": "D", "transmission": "T", "diffuse": "DS"}
    groups = by_receiver(lines)
    text = ["# <receiver> <paths>", str(len(groups) + 1)]
    for number, group in enumerate(groups, 1):
        text += [f"{number} {len(group)}", "-80.0 1e-7 1e-8"]
        for path, line in enumerate(group, 1):
            level = line.power_db + TX_POWER_DBM
            text.append(
                f"{path} {len(line.types)} {level:.12g} {phase}{line.delay:.12g} 84.0 40.3 90.9 -13.4"
            )
            text.append("-".join(["Tx", *(letters[name] for name in line.types), "Rx"]))
            text += [" ".join(f"{value:.9g}" for value in point) for point in line.points]
    text.append(f"{len(groups) + 1} 0")
    file = folder / "street.paths.t001_01.r002.p2m"
    file.write_text("\n".join(text))
    return file


def write_aodt(
    lines: list[Polyline], folder: Path, element_as: Callable[[int], object] = int, transmitting: int = 1
) -> Path:
    rays, gains = [], []
    for ue, group in enumerate(by_receiver(lines)):
        pair = {"time_idx": 0, "ru_id": 1, "ue_id": ue}
        for line in group:
            types = ["emission", *line.types, "reception"]
            points = [dict(zip("123", point, strict=True)) for point in (100 * line.points).tolist()]
            rays.append(pair | {"points": points, "interaction_types": types})
        amplitude = 10 ** (np.array([line.power_db for line in group]) / 20)
        for number, share in enumerate((0.6, 0.8) * transmitting):
            source, element = element_as(number // 2), element_as(number % 2)
            gains.append(
                pair
                | {"ru_ant_el": source, "ue_ant_el": element, "cir_re": (share * amplitude).tolist(),
                   "cir_im": (0 * amplitude).tolist(), "cir_delay": [line.delay for line in group]}
            )  # fmt: skip
    for name, rows in (("raypaths", rays), ("cirs", gains)):
        # Rows of a pair keep their order, but pairs come in any.
        frame = pd.DataFrame(rows)
        frame.iloc[np.argsort(-frame.ue_id.to_numpy(), kind="stable")].to_parquet(folder / f"{name}.parquet")
    return folder


def write_deepmimo(lines: list[Polyline], folder: Path, ending: str = "mat") -> Path:
    digits = {"reflection": "1", "diffraction": "2", "diffuse": "3", "transmission": "4"}
    groups = by_receiver(lines)
    shape = len(groups), max(len(group) for group in groups)
    content = {name: np.full(shape, np.nan) for name in ("power", "delay", "inter")}
    content["inter_pos"] = np.full((*shape, 2, 3), np.nan)
    content["tx_pos"] = lines[0].points[:1]
    content["rx_pos"] = np.array([group[0].points[-1] for group in groups])
    for rx, group in enumerate(groups):
        for path, line in enumerate(group):
            content["power"][rx, path], content["delay"][rx, path] = line.power_db, line.delay
            content["inter"][rx, path] = int("".join(digits[name] for name in line.types) or 0)
            content["inter_pos"][rx, path, : len(line.types)] = line.points[1:-1]
    for name, values in content.items():
        file = folder / f"{name}_t001_tx000_r002.{ending}"
        np.savez(file, data=values) if ending == "npz" else savemat(file, {name: values})
    return folder


def write_matlab(lines: list[Polyline], folder: Path) -> Path:
    if shutil.which("octave-cli") is None:
        pytest.skip("GNU Octave is not installed")

    def vector(point: np.ndarray) -> str:
        return "[" + "; ".join(f"{value:.12g}" for value in point) + "]"

    cells = []
    for group in by_receiver(lines):
        rays = []
        for line in group:
            hits = ", ".join(
                f"struct('Type', '{name.capitalize()}', 'Location', {vector(point)})"
                for name, point in zip(line.types, line.points[1:-1], strict=True)
            )
            rays.append(
                f"struct('CoordinateSystem', 'Cartesian', 'TransmitterLocation', {vector(line.points[0])}, "
                f"'ReceiverLocation', {vector(line.points[-1])}, 'LineOfSight', {'false' if hits else 'true'}, "
                f"'Interactions', {{[{hits}]}}, 'PathLoss', {-line.power_db:.12g}, "
                f"'PropagationDelay', {line.delay:.12g})"
            )
        cells.append("[" + "; ".join(rays) + "]")
    file = folder / "rays.csv"
    script = folder / "run.m"
    script.write_text(f"rays = {{{', '.join(cells)}}};\nrays_to_table(rays, '{file}');\n")
    command = ["octave-cli", "--quiet", "--path", str(MATLAB), str(script)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return file


WRITERS: dict[str, Callable[[list[Polyline], Path], Path]] = {
    "InSite": write_insite,
    "InSite without phases": lambda lines, folder: write_insite(lines, folder, phase=""),
    "AODT": write_aodt,
    "AODT, elements as structs": lambda lines, folder: write_aodt(
        lines, folder, lambda number: {"row": 0, "column": number, "port": 1}, transmitting=2
    ),
    "AODT, elements as lists": lambda lines, folder: write_aodt(
        lines, folder, lambda number: [0, number, 1], transmitting=2
    ),
    "DeepMIMO": write_deepmimo,
    "DeepMIMO npz": lambda lines, folder: write_deepmimo(lines, folder, "npz"),
    "MATLAB": write_matlab,
}


@pytest.mark.parametrize("program", WRITERS)
def test_every_program_gives_the_powers_of_sionna_back(
    lines: list[Polyline], tmp_path: Path, program: str
) -> None:
    source = WRITERS[program](lines, tmp_path)
    program_read = read(source, tx_power_dbm=TX_POWER_DBM if program.startswith("InSite") else None)
    true = [sorted(10 ** (line.power_db / 10) for line in group) for group in by_receiver(lines)]
    ends = np.lexsort(program_read.rx_position.T[::-1])
    mine = [np.sort(powers(program_read)[program_read.link == link]) for link in ends]
    for one, other in zip(mine, true, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def test_axes_and_units_of_another_convention_are_refused_or_named(
    lines: list[Polyline], tmp_path: Path
) -> None:
    upright = [line._replace(points=line.points[:, [0, 2, 1]] * [1, 1, -1]) for line in lines]
    file = write_insite(upright, tmp_path)
    with pytest.raises(InputError, match="nearest surface"):
        read(file, tx_power_dbm=TX_POWER_DBM)
    turned = read(file, tx_power_dbm=TX_POWER_DBM, axes="x -z y")
    assert turned.num_paths == len(lines)
    metres = write_aodt([line._replace(points=line.points / 100) for line in lines], tmp_path)
    with pytest.raises(InputError, match=r"nearest surface|takes"):
        read(metres)


def test_aodt_s_gains_are_those_of_the_paths_time(lines: list[Polyline], tmp_path: Path) -> None:
    """At time 0 there are gains, but no paths; the first paths are those of time 1."""
    folder = write_aodt(lines, tmp_path)
    expected = read(folder)
    rays, gains = (pd.read_parquet(folder / f"{name}.parquet") for name in ("raypaths", "cirs"))
    before = gains.assign(cir_re=[values / 100 for values in gains.cir_re])
    rays.assign(time_idx=1).to_parquet(folder / "raypaths.parquet")
    pd.concat([before, gains.assign(time_idx=1)]).to_parquet(folder / "cirs.parquet")
    np.testing.assert_allclose(path_loss(read(folder)), path_loss(expected))


@pytest.mark.parametrize("given", ["list", "folder"])
def test_several_files_of_insite_are_read_together(lines: list[Polyline], tmp_path: Path, given: str) -> None:
    """A joined file is refused, because the number of receivers in its first line is that of the first file."""
    groups = by_receiver(lines)
    files = []
    for number, part in enumerate((groups[0], [line for group in groups[1:] for line in group])):
        file = write_insite(part, tmp_path)
        files.append(file.rename(tmp_path / f"street.paths.t001_0{number}.r002.p2m"))
    (tmp_path / "street.power.t001_01.r002.p2m").write_text("# no paths")
    together = read(files if given == "list" else tmp_path, tx_power_dbm=TX_POWER_DBM)
    assert (together.num_links, together.num_paths) == (len(groups), len(lines))
    joined = tmp_path / "joined.p2m"
    joined.write_text("\n".join(file.read_text() for file in files))
    number = len(files[0].read_text().splitlines()) + 2
    with pytest.raises(
        InputError, match=rf"joined\.p2m, line {number}: '3' follows the last receiver.* in line 2;"
    ):
        read(joined, tx_power_dbm=TX_POWER_DBM)


def without_a_gain(folder: Path) -> None:
    gains = pd.read_parquet(folder / "cirs.parquet")
    gains.at[0, "cir_re"] = np.array([np.nan, *gains.cir_re[0][1:]])
    gains.to_parquet(folder / "cirs.parquet")


def without_a_power(folder: Path) -> None:
    file = folder / "power_t001_tx000_r002.mat"
    power = loadmat(file)["power"]
    power[0, 0] = np.nan
    savemat(file, {"power": power})


REFUSED = {
    "a gain that is not a number": (write_aodt, without_a_gain, {}, "the power of path .* is NaN"),
    "a power that is not a number": (write_deepmimo, without_a_power, {}, "the power of path 0, from .* is NaN"),
    "no transmitted power": (write_insite, lambda file: None, {}, "give tx_power_dbm"),
    "a text as transmitted power": (write_insite, lambda file: None, {"tx_power_dbm": "13"}, "'13': must be a finite"),
    "no number as transmitted power": (write_insite, lambda file: None, {"tx_power_dbm": np.nan}, "must be a finite"),
    "a cut file": (
        write_insite,
        lambda file: file.write_text(file.read_text()[:-60]),
        {"tx_power_dbm": 13.0},
        "ends within a path|must contain",
    ),
    "a missing file": (write_insite, Path.unlink, {"tx_power_dbm": 13.0}, "no such file"),
    "foliage": (
        write_insite,
        lambda file: file.write_text(file.read_text().replace("Tx-R-Rx", "Tx-X-Rx", 1)),
        {"tx_power_dbm": 13.0},
        "'X'",
    ),
    "a missing table": (write_aodt, lambda folder: (folder / "cirs.parquet").unlink(), {}, "no such file"),
    "a missing column": (
        write_aodt,
        lambda folder: (
            pd.read_parquet(folder / "raypaths.parquet").drop(columns="points").to_parquet(folder / "raypaths.parquet")
        ),
        {},
        "points",
    ),
    "gains of another run": (
        write_aodt,
        lambda folder: (
            pd.read_parquet(folder / "raypaths.parquet").iloc[1:].to_parquet(folder / "raypaths.parquet")
        ),
        {},
        "gains for ru_id",
    ),
    "a missing matrix": (
        write_deepmimo,
        lambda folder: (folder / "inter_t001_tx000_r002.mat").unlink(),
        {},
        r"inter_t001_tx000_r002\.mat: no such file",
    ),
    "no matrix": (
        write_deepmimo,
        lambda folder: (folder / "delay_t001_tx000_r002.mat").write_text("power"),
        {},
        "not a matrix",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", REFUSED)
def test_a_wrong_file_is_refused(lines: list[Polyline], tmp_path: Path, fault: str) -> None:
    write, spoil, arguments, message = REFUSED[fault]
    source = write(lines, tmp_path)
    spoil(source)
    with pytest.raises(InputError, match=message):
        read(source, **arguments)


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("cirs", "cir_re", None), ("cirs", "cir_im", 0.1), ("cirs", "cir_delay", "[1e-8]"),
        ("raypaths", "interaction_types", None), ("raypaths", "interaction_types", "emission"),
        ("raypaths", "points", None), ("raypaths", "points", "0 0 1"),
    ],
)  # fmt: skip
def test_a_cell_that_is_no_list_is_refused(
    lines: list[Polyline], tmp_path: Path, table: str, column: str, value: object
) -> None:
    file = write_aodt(lines, tmp_path) / f"{table}.parquet"
    frame = pd.read_parquet(file)
    frame.assign(**{column: [value] * len(frame)}).to_parquet(file)
    with pytest.raises(
        InputError, match=r"must be (a list of (numbers|names)|triples).*export the table again"
    ):
        read(tmp_path)


def test_paths_of_sionna_at_another_carrier_are_refused(paths: rt.Paths) -> None:
    check_carrier(paths, FREQUENCY)
    check_carrier("rays.csv", 28e9)
    with pytest.raises(InputError, match=r"solved at 3\.5 GHz, but must be solved at 28 GHz"):
        cb.read_rays(paths, SCENE, frequency=28e9)


def test_a_folder_without_paths_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"raypaths\.parquet"):
        read(tmp_path)
    with pytest.raises(InputError, match="two more points"):
        rows_of([Polyline(np.zeros((2, 3)), ["reflection"], -80.0)], "made up")
