"""Accidents and intrusions: names that become code, links in place of outputs, other folders, repeats, bombs."""

from __future__ import annotations

import io
import os
import tomllib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
import pandas as pd
import pyarrow as pa
import rasterio
from pyarrow import parquet

from calibray.coordinates import Frame
from calibray.fields import path_loss
from calibray.measurements import read_measurements, read_table
from calibray.measurements.table_files import PiecedTable
from calibray.scenes.authoring import read_plan, read_terrain
from calibray.study import Study
from fuzzing import world
from fuzzing.outcome import Case
from fuzzing.world import OWN, World

PLANTED = "pwned"
INJECTIONS = (
    '\n[engine]\nname = "command"\ncommand = ["sh", "-c", "touch pwned"]\n',
    '"\n[engine]\ncommand = ["touch", "pwned"]\n#',
    "'''\n[engine]\n",
    "\r[engine]\rname='command'\r",
    "\u2028[engine]",
    "\x85[engine]",
    "<script>alert('pwned')</script>",
    "</script><script>alert('pwned')</script>",
    '"><img src=x onerror=alert("pwned")>',
    '=HYPERLINK("http://x.invalid","pwned")',
    "+cmd|' /C calc'!A0",
    "@SUM(1+1)",
    "-2+3+cmd",
    "\t=1+1",
    "a,b\n=1",
    "\x1b[2Jpwned",
    "{{7*7}}",
    "`touch pwned`",
    "$(touch pwned)",
    "\\\\evil\\x",
    "\x7f",
    "\u202epwned",
)
"""Names that are code in TOML, HTML, CSV, a shell or a terminal."""

_SPOKEN = ("links.csv", "column", "study", "links", "half", "loss", "[", "name")


def name(rng: Random, found: World, folder: Path) -> Case:
    """Columns or groups whose names are code: drafts, tables and pages quote them."""
    study = found.copy(folder)
    table = pd.read_csv(io.StringIO(world.LINKS))
    text = rng.choice(INJECTIONS)
    if rng.random() < 0.5:
        column = rng.choice(("x", "y", "loss", "half", "w", "extra"))
        new = rng.choice((text, f"{column}{text}", f"{text} {column}"))
        table.assign(extra=1.0).rename(columns={column: new}).to_csv(folder / "links.csv", index=False)
        draft = folder / "draft.toml"

        def act() -> list[float]:
            words = (
                "init",
                folder / "scene.xml",
                folder / "links.csv",
                "--frequency",
                "3.5e9",
                "--tx=0,0,2",
                "-o",
                draft,
            )
            world.calibray(*words)
            content = tomllib.loads(draft.read_text())
            return [float("engine" in content or (folder / PLANTED).exists())]

        return Case(
            "name", f"init, {column} is {new[:60]!r}", act, expected=[0.0], names=_SPOKEN, own=("draft",)
        )
    table["half"] = table["half"].replace("a", text)
    table.to_csv(folder / "links.csv", index=False)
    tree = world.content(holdout={"where": "x > 55"})
    tree["links"]["where"] = "loss < 200"
    study.write_text(world.toml(tree))

    def run() -> list[float]:
        world.rmse(study, "-o", folder / "out")
        page = (folder / "out" / "report.html").read_text()
        cells = (
            pd.read_csv(folder / "out" / "result-links.csv", keep_default_na=False)
            .astype(str)
            .to_numpy()
            .ravel()
        )
        formulas = [cell for cell in cells if cell[:1] in "=+@\t\r" and not _is_number(cell)]
        return [float("<script>alert" in page or "<img src=x" in page), float(len(formulas))]

    return Case("name", f"run, group {text[:60]!r}", run, expected=[0.0, 0.0], names=_SPOKEN, own=OWN)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return text in ("", "\t", "\r")
    return True


OCCUPANTS: dict[str, Callable[[Path, Path], object]] = {
    "link": lambda place, mine: place.symlink_to(mine),
    "link to nothing": lambda place, mine: place.symlink_to(mine.with_name("gone")),
    "second name": lambda place, mine: place.hardlink_to(mine),
    "FIFO": lambda place, _: os.mkfifo(place),
    "folder": lambda place, _: place.mkdir(),
    "zeros": lambda place, _: place.symlink_to("/dev/zero"),
    "foreign file": lambda place, mine: place.write_bytes(mine.read_bytes()),
}
"""What stands in place of an output."""

_OUTPUTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "run": (
        (
            "result.json",
            "result-links.csv",
            "result-history.csv",
            "result-scene.xml",
            "report.html",
            ".calibray",
        ),
        ("study.toml", "-o", "out"),
    ),
    "run --engine": (
        ("ledger.sqlite", "ledger.sqlite-wal", ".calibray"),
        ("study.toml", "-o", "out", "--engine", "command"),
    ),
    "trace": (("paths.h5", ".calibray"), ("study.toml", "-o", "out/paths.h5")),
    "init": (
        ("draft.toml", "study.schema.json", ".calibray"),
        ("scene.xml", "links.csv", "--frequency=1e9", "--tx=0,0,2", "-o", "out/draft.toml"),
    ),
    "export": (("scene.xml", "load_scene.py", ".calibray"), ("done", "-o", "out")),
    "predict": (("told.csv", ".calibray"), ("done", "new.csv", "-o", "out/told.csv")),
}
"""Outputs by command, and its arguments."""


def occupied(rng: Random, found: World, folder: Path) -> Case:
    """A link, a FIFO, a device, a folder or a foreign file in place of an output: nothing is followed or replaced."""
    found.copy(folder)
    command = rng.choice(list(_OUTPUTS))
    outputs, arguments = _OUTPUTS[command]
    if "done" in arguments:
        found.copy(folder, "out")
        (folder / "out").rename(folder / "done")
    (folder / "out").mkdir()
    output, occupant = rng.choice(outputs), rng.choice(list(OCCUPANTS))
    OCCUPANTS[occupant](folder / "out" / output, folder / "notes.txt")
    extra = (
        ("--overwrite",) if rng.random() < 0.3 and command in ("run", "trace", "predict", "export") else ()
    )

    def act() -> list[float]:
        here = Path.cwd()
        os.chdir(folder)
        try:
            world.calibray(command.split()[0], *arguments, *extra)
        finally:
            os.chdir(here)
        return [float((folder / "gone").exists())]

    names = ("out", ".calibray", "ledger", "done")
    note = f"{command}, {occupant} at {output} {' '.join(extra)}"
    return Case("occupied", note, act, expected=[0.0], names=names, own=OWN)


def elsewhere(rng: Random, found: World, folder: Path) -> Case:
    """Traced from a folder with another scene whose meshes have the same names: the right path loss comes out."""
    study = found.copy(folder)
    other = folder / "other"
    found.copy(other)
    for file in (other / "meshes").iterdir():
        file.write_text(file.read_text().replace("12", "3"))
    (folder / "cache").mkdir()
    target = rng.choice((study, Path("../study.toml"), Path("../other/../study.toml")))

    def act() -> list[float]:
        here = Path.cwd()
        os.chdir(other)
        os.environ["CALIBRAY_CACHE"] = str(folder / "cache")
        try:
            setup = Study.load(target).opened()
            return np.asarray(path_loss(setup.tracer.trace(setup.links))).tolist()
        finally:
            os.chdir(here)

    right = found.right["path_loss"]
    return Case("elsewhere", str(target)[:40], act, expected=right, own=(*OWN, "cache"))


def repeats(rng: Random, found: World, folder: Path) -> Case:
    """Rows logged several times, with rounding errors and in any order: they count once."""
    rows = [line.split(",") for line in world.LINKS.splitlines()]
    step = rng.choice((0.0, 1e-12, 1e-9, 1e-7))
    copies = [
        [*(repr(float(cell) + step * rng.choice((-1, 0, 1))) for cell in row[:3]), *row[3:]]
        for row in rng.choices(rows[1:], k=rng.randint(1, 20))
    ]
    table = [*rows[1:], *copies]
    rng.shuffle(table)
    file = folder / "links.csv"
    file.write_text("\n".join(",".join(row) for row in [rows[0], *table]) + "\n")

    def act() -> list[float]:
        links = read_measurements(file, [0.0, 0.0, 2.0], ["x", "y", 1.5], "loss", group="half", weight="w")
        order = np.lexsort(np.round(links.rx[:, :2].T, 4))
        return np.round(np.column_stack([links.rx[:, :2], links.path_loss_db])[order], 4).ravel().tolist()

    right = np.array([[float(cell) for cell in row[:3]] for row in rows[1:]])
    right = right[np.lexsort(right[:, :2].T)]
    return Case("repeats", f"{len(copies)} within {step}", act, expected=right.ravel().tolist())


def bomb(rng: Random, found: World, folder: Path) -> Case:
    """A Parquet file whose rows share a large text, or with damaged pages: refused, or read within bounds."""
    file = folder / "links.parquet"
    size, rows = 2 ** rng.randint(16, 24), 2 ** rng.randint(10, 17)
    index = pa.array(np.zeros(rows, dtype=np.int32))
    shared = pa.DictionaryArray.from_arrays(index, pa.array(["x" * size]))
    parquet.write_table(
        pa.table({"x": shared, "loss": np.full(rows, 80.0)}), file, store_schema=False,
        dictionary_pagesize_limit=2**30, compression=rng.choice(("zstd", "gzip", "snappy")),
        row_group_size=rng.choice((rows, 1000)),
    )  # fmt: skip
    if rng.random() < 0.3:
        raw = bytearray(file.read_bytes())
        for _ in range(rng.randint(1, 4)):
            raw[rng.randrange(4, min(len(raw), 60))] ^= 1 << rng.randrange(8)  # the first page's header
        file.write_bytes(raw)
    read = rng.choice((lambda: [len(read_table(file))], lambda: [PiecedTable.open(file).rows]))
    large = size * rows > 2**33
    return Case("bomb", f"{rows} rows of {size} bytes", read, damaged=large, names=("links.parquet",))


HERE = Frame.local(11.5, 48.1)


def terrain(rng: Random, found: World, folder: Path) -> Case:
    """A height model with units, scales, gaps and other formats: heights of a slope are right, or it is refused."""
    file = folder / "ground.tif"
    columns, rows = 40, 30
    height = 100 + 0.5 * np.arange(columns)[None].repeat(rows, axis=0)
    unit = rng.choice((None, None, "m", "ft", "foot", "US survey foot", "cm", "fathom", "degree", ""))
    metres = {"ft": 0.3048, "foot": 0.3048, "US survey foot": 1200 / 3937, "cm": 0.01}.get(unit or "", 1.0)
    scale, offset = rng.choice((1.0, 1.0, 0.1, 0.01)), rng.choice((0.0, 0.0, 400.0))
    stored = (height / metres - offset) / scale
    gap = rng.choice((None, None, None, -32768, -9999, 1e20, np.nan))
    if gap is not None:
        stored[3, 7] = gap
    nodata = gap if gap is not None and rng.random() < 0.5 else None
    profile = {"driver": "GTiff", "width": columns, "height": rows, "count": 1, "dtype": "float64"}
    grid = rasterio.Affine(0.005, 0, 11.4, 0, -0.005, 48.2)
    kind = rng.choice(("plain", "plain", "plain", "huge", "VRT", "bytes"))
    with rasterio.open(file, "w", crs="EPSG:4326", transform=grid, nodata=nodata, **profile) as dataset:
        dataset.write(stored, 1)
        dataset.scales, dataset.offsets = (scale,), (offset,)
        if unit:
            dataset.units = (unit,)
    if kind == "huge":
        profile |= {"width": 400_000, "height": 300_000, "dtype": "uint8"}
        options = {"tiled": True, "compress": "deflate", "sparse_ok": True, "BIGTIFF": "YES"}
        fine = rasterio.Affine(5e-7, 0, 11.4, 0, -5e-7, 48.2)
        with rasterio.open(file, "w", crs="EPSG:4326", transform=fine, **profile, **options):
            pass
    elif kind == "VRT":
        file.write_text(
            '<VRTDataset rasterXSize="40" rasterYSize="30"><SRS>EPSG:4326</SRS><GeoTransform>11.4, 0.005, 0, 48.2, 0, '
            '-0.005</GeoTransform><VRTRasterBand dataType="Float64" band="1"><SimpleSource><SourceFilename>'
            "/etc/passwd</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
        )
    elif kind == "bytes":
        raw = bytearray(file.read_bytes())
        for _ in range(rng.randint(1, 8)):
            raw[rng.randrange(min(len(raw), 700))] ^= 1 << rng.randrange(8)
        file.write_bytes(raw)

    def act() -> list[float]:
        ground = read_terrain(file, HERE, [-500.0, -500.0, 500.0, 500.0])
        lowest, highest = ground.heights([-400.0, 400.0], [0.0, 0.0])
        return [] if kind in ("bytes", "huge") else [round(float(highest - lowest), 1)]

    # 800 m at this latitude are 0.01075 degrees, 2.15 cells of half a metre.
    right = None if kind in ("bytes", "huge") else [1.1]
    note = f"{kind}, unit {unit!r}, scale {scale}, offset {offset}, gap {gap}, nodata {nodata}"
    return Case(
        "terrain", note, act, damaged=kind == "VRT", expected=right, names=("ground.tif", "height model")
    )


def polyline(rng: Random, found: World, folder: Path) -> Case:
    """A floor plan of polylines and outlines with points repeated, out of range, or of another dimension."""
    points = [(rng.uniform(0, 9), rng.uniform(0, 9)) for _ in range(rng.randint(2, 6))]
    if rng.random() < 0.4:
        points.insert(rng.randrange(len(points)), points[0])
    words = [f"{x} {y}" for x, y in points]
    if rng.random() < 0.4:
        words[rng.randrange(len(words))] = rng.choice(
            ("nan nan", "inf 0", "1e300 0", "1 2 3", "x y", "1", "EMPTY")
        )
    shape = rng.choice(
        ("LINESTRING ({})", "POLYGON (({}))", "MULTILINESTRING (({}))", "POINT ({})", "CURVE({})", "{}")
    )
    (folder / "plan.csv").write_text(f'wkt,type\n"{shape.format(", ".join(words))}",brick\n')

    def act() -> list[float]:
        return [segment.length for segment in read_plan(folder / "plan.csv")]

    plain = shape.startswith("LINESTRING") and all(len(word.split()) == 2 for word in words)
    right = None
    if plain and not set("naifxe") & set("".join(words).lower()):
        right = [float(np.hypot(b[0] - a[0], b[1] - a[1])) for a, b in pairwise(points) if a != b]
    return Case("polyline", shape.format("; ".join(words))[:100], act, expected=right, names=("plan",))
