"""Floor plans: faces merged into sheets, walls that meet, doors in walls, floors; bad plans are refused."""

from __future__ import annotations

import gzip
import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh

from calibray.errors import InputError
from calibray.scenes import read_scene
from calibray.scenes.authoring import Segment, SurfaceMaterial, make_plan_scene, merge_faces, read_plan


def line(x0, y0, x1, y1, kind="brick", bottom=0.0, top=3.0, thickness=None) -> Segment:
    return Segment((x0, y0), (x1, y1), kind, bottom, top, thickness)


OUTER = [line(0, 0, 10, 0), line(10, 0, 10, 6), line(10, 6, 0, 6), line(0, 6, 0, 0)]
ROOMS = [
    line(0.2, 0.2, 4.9, 0.2), line(5.1, 0.2, 9.8, 0.2), line(9.8, 0.2, 9.8, 5.8), line(9.8, 5.8, 5.1, 5.8),
    line(4.9, 5.8, 0.2, 5.8), line(0.2, 5.8, 0.2, 0.2), line(4.9, 0.2, 4.9, 5.8), line(5.1, 0.2, 5.1, 5.8),
]  # fmt: skip
"""The inner faces of two rooms of a house 10 m x 6 m, all walls 20 cm thick."""


def mesh(folder: Path, name: str) -> trimesh.Trimesh:
    return trimesh.load_mesh(folder / "meshes" / f"all-{name}.ply", process=False)


def test_the_faces_of_a_house_become_five_sheets():
    merged = merge_faces([*OUTER, *ROOMS])
    sheets = merged.sheets
    assert merged.lines == 12
    ends = [sorted(np.round([sheet.start, sheet.end], 6).tolist()) for sheet in sheets]
    expected = [
        ((0.1, 0.1), (9.9, 0.1)), ((9.9, 0.1), (9.9, 5.9)), ((0.1, 5.9), (9.9, 5.9)), ((0.1, 0.1), (0.1, 5.9)),
        ((5.0, 0.2), (5.0, 5.8)),
    ]  # fmt: skip
    np.testing.assert_allclose(
        sorted(ends), sorted([list(end) for end in line] for line in expected), atol=1e-9
    )
    assert {sheet.thickness for sheet in sheets} == {0.2}


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0])
def test_merging_does_not_depend_on_the_orientation_of_the_plan(angle):
    cosine, sine = np.cos(angle), np.sin(angle)

    def rotated(segment):
        ends = [(cosine * x - sine * y, sine * x + cosine * y) for x, y in (segment.start, segment.end)]
        return Segment(*ends, segment.kind, segment.bottom, segment.top)

    sheets = merge_faces([rotated(segment) for segment in [*OUTER, *ROOMS]]).sheets
    assert sorted(sheet.length for sheet in sheets) == pytest.approx([5.6, 5.8, 5.8, 9.8, 9.8])


@pytest.mark.parametrize(
    ("other", "merges"),
    [
        (line(0, 0.3, 4, 0.3), True),
        (line(4, 0.3, 0, 0.3), True),
        (line(0, 0.9, 4, 0.9), False),
        (line(0, 0.3, 4, 0.3, "concrete"), False),
        (line(0, 0.3, 4, 0.3, top=2.0), False),
        (line(0, 0.3, 4, 0.3, thickness=0.1), False),
        (line(0, 0.3, 4, 0.3, thickness=0.31), True),
        (line(3.5, 0.3, 9, 0.3), False),
        (line(0, 0.3, 4, 1.2), False),
        (line(4.5, 0, 9, 0), False),
    ],
    ids=[
        "face",
        "reversed",
        "far",
        "type",
        "height",
        "thickness",
        "thick",
        "side by side",
        "askew",
        "in line",
    ],
)
def test_lines_are_faces_of_one_wall_only_if_all_conditions_hold(other, merges):
    assert merge_faces([line(0, 0, 4, 0), other]).lines == (2 if merges else 0)


def area(sheets) -> float:
    return sum(sheet.length * (sheet.top - sheet.bottom) for sheet in sheets)


def test_what_is_left_of_a_longer_face_is_kept():
    """An outer wall whose inner face is drawn in two of four rooms only; the second wall is staggered."""
    wall = [line(0, 0, 12, 0), line(0.2, 0.2, 3, 0.2), line(3.1, 0.2, 6, 0.2)]
    merged = merge_faces(wall)
    (sheet,) = merged.sheets
    assert (sheet.start, sheet.end) == (pytest.approx((0.1, 0.1)), pytest.approx((12.0, 0.1)))
    assert merged.report == [
        "brick: 2 merged from two faces, 0.20 m apart, 5.8 m long",
        "brick: 1 kept from a face that is longer than the opposite face, 6.0 m long",
        "brick: walls without a thickness get 0.2 m",
    ]
    (staggered,) = merge_faces([line(0, 0, 10, 0), line(4, 0.2, 14, 0.2)]).sheets
    assert staggered.length == pytest.approx(14.0)


def test_two_walls_near_each_other_stay_two_walls_in_a_plan_of_single_lines():
    """A house drawn as single lines, with a shaft 0.44 m wide along its outer wall."""
    shaft = line(0.44, 0, 0.44, 6)
    merged = merge_faces([*OUTER, line(5, 0, 5, 6), shaft])
    assert list(merged.sheets) == [*OUTER, line(5, 0, 5, 6), shaft]
    assert merged.lines == 0
    assert merged.report == [
        "brick: 1 not merged with a parallel line, because most lines of this type have no opposite face, "
        "0.44 m apart, 6.0 m long"
    ]
    # Drawn as single lines of another type, the same two lines are the whole type, and one wall.
    assert merge_faces([*OUTER, line(2, 0, 2, 6, "glass"), line(2.44, 0, 2.44, 6, "glass")]).lines == 2


def outlined() -> str:
    """A flat of 12 m x 8 m as closed outlines of its walls, drawn with errors of millimetres; a door, a window."""
    boxes = [
        (0, 0, 12, 0.3), (0, 7.697, 12, 8), (0, 0.3, 0.302, 7.7), (11.703, 0.3, 12, 7.7),
        (5, 0.3, 5.299, 3), (5, 3.9, 5.301, 7.7), (0.3, 4, 3.2, 4.298), (5.3, 5, 11.7, 5.3),
    ]  # fmt: skip
    rows = [f'"POLYGON (({x} {y}, {u} {y}, {u} {v}, {x} {v}, {x} {y}))",brick' for x, y, u, v in boxes]
    return "\n".join(["wkt,type", *rows, '"LINESTRING (5.15 3, 5.15 3.9)",door', ""])


def test_walls_drawn_as_closed_outlines_become_one_sheet_each_of_one_material(tmp_path):
    (tmp_path / "plan.csv").write_text(outlined())
    segments = read_plan(tmp_path / "plan.csv", 2.5)
    assert len(segments) == 8 * 4 + 1
    made = make_plan_scene(segments, tmp_path / "flat", lids=())
    materials = read_scene(made.path, 5e9).materials
    assert {name: material.thickness for name, material in materials.items()} == {
        "brick_wall": pytest.approx(0.3, abs=0.004), "door": 0.04,
    }  # fmt: skip
    walls = mesh(tmp_path / "flat", "brick_wall")
    # Centre lines: outside 2 x 11.7 m and 2 x 7.7 m, inside 2.85 m + 3.95 m, 3.05 m and 6.7 m; a corner counts once.
    assert walls.area == pytest.approx((2 * 11.7 + 2 * 7.7 + 2.85 + 3.95 + 3.05 + 6.7) * 2.5, rel=0.01)
    assert any("ends of outlined walls left out" in text for text in made.walls)
    assert json.loads((tmp_path / "flat" / "scene.json").read_text())["walls"] == list(made.walls)


DXF = """0 SECTION 2 ENTITIES
0 LWPOLYLINE 8 brick 90 4 70 1 10 0 20 0 10 5000 20 0 10 5000 20 4000 10 0 20 4000
0 POLYLINE 8 glass 66 1 70 0 0 VERTEX 8 glass 10 1000 20 0 0 VERTEX 8 glass 10 2000 20 0 0 SEQEND
0 LINE 8 door 10 0 20 1000 11 0 21 1750 0 TEXT 8 notes 10 1 20 1 40 1 1 kitchen 0 ENDSEC 0 EOF"""
JSON = {
    "type": "FeatureCollection",
    "features": [
        {"type": "Feature", "properties": {"type": kind}, "geometry": {"type": shape, "coordinates": points}}
        for kind, shape, points in [
            ("brick", "Polygon", [[[0, 0], [5000, 0], [5000, 4000], [0, 4000], [0, 0]]]),
            ("glass", "LineString", [[1000, 0], [2000, 0]]),
            ("door", "MultiLineString", [[[0, 1000], [0, 1750]]]),
            ("notes", "Point", [1, 1]),
        ]
    ],
}


@pytest.mark.parametrize("ending", ["dxf", "geojson"])
def test_polylines_of_vector_files_are_read(tmp_path, ending):
    path = tmp_path / f"plan.{ending}"
    path.write_text("\n".join(DXF.split()) + "\n" if ending == "dxf" else json.dumps(JSON))
    plan = read_plan(path, height=2.5, unit=0.001)
    corners = [(0, 0), (5, 0), (5, 4), (0, 4), (0, 0)]
    walls = [line(*a, *b, top=2.5) for a, b in pairwise(corners)]
    assert plan == [*walls, line(1, 0, 2, 0, "glass", top=2.5), line(0, 1, 0, 1.75, "door", top=2.5)]


@pytest.mark.parametrize(("code", "unit"), [(4, 0.001), (5, 0.01), (1, 0.0254), (6, 1.0), (0, 1.0)])
def test_the_unit_of_a_dxf_is_that_of_its_header_unless_stated(tmp_path, caplog, code, unit):
    path = tmp_path / "plan.dxf"
    header = f"0 SECTION 2 HEADER 9 $ACADVER 1 AC1015 9 $INSUNITS 70 {code} 0 ENDSEC "
    path.write_text("\n".join((header + DXF).split()) + "\n")
    assert read_plan(path)[0].length == pytest.approx(5000 * unit)
    assert any(f"states a unit of {unit:g} m" in message for message in caplog.messages) == (unit != 1)
    assert read_plan(path, unit=0.001)[0].length == pytest.approx(5)


def test_blocks_of_a_dxf_are_named_because_their_walls_are_not_read(tmp_path, caplog):
    path = tmp_path / "plan.dxf"
    header = "0 SECTION 2 HEADER 9 $ACADVER 1 AC1015 0 ENDSEC "
    room = "0 BLOCK 8 0 2 ROOM 70 0 10 0 20 0 3 ROOM 0 LINE 8 brick 10 0 20 0 11 0 21 3 0 ENDBLK 8 0"
    inserted = "0 SECTION 2 ENTITIES 0 INSERT 8 walls 2 ROOM 10 4 20 0 0 INSERT 8 walls 2 ROOM 10 8 20 0"
    dxf = header + f"0 SECTION 2 BLOCKS {room} 0 ENDSEC " + DXF.replace("0 SECTION 2 ENTITIES", inserted)
    path.write_text("\n".join(dxf.split()) + "\n")
    assert len(read_plan(path)) == 6
    assert any("blocks are not read (2 inserted: ROOM)" in message for message in caplog.messages)


def test_a_file_that_is_dxf_for_one_driver_and_vrt_for_another_is_refused(tmp_path):
    path = tmp_path / "plan.dxf"
    path.write_text("0\nSECTION\n<OGRVRTDataSource><OGRVRTLayer/></OGRVRTDataSource>")
    with pytest.raises(InputError, match="is not in a supported format"):
        read_plan(path)


def test_walls_that_meet_share_their_corners(tmp_path):
    made = make_plan_scene([*OUTER, *ROOMS], tmp_path)
    walls = mesh(tmp_path, "brick_wall")
    # Two T-junctions cut the long walls: seven pieces between six columns of two corners.
    assert (len(walls.vertices), len(walls.faces)) == (12, 14)
    assert walls.area == pytest.approx((2 * 9.8 + 3 * 5.8) * 3.0, rel=1e-6)
    assert (
        mesh(tmp_path, "floor").area == mesh(tmp_path, "ceiling").area == pytest.approx(9.8 * 5.8, rel=1e-6)
    )
    assert made.bounds == pytest.approx((0.1, 0.1, 0.0, 9.9, 5.9, 3.0))
    assert made.counts == {"lines": 12, "sheets": 5, "lines merged as faces of one wall": 12}


def test_doors_and_windows_replace_the_wall(tmp_path):
    plan = [*OUTER, line(2, 0, 3, 0, "door", 0.0, 2.1), line(10, 2, 10, 4, "window", 0.9, 2.2)]
    make_plan_scene(plan, tmp_path, lids=())
    assert mesh(tmp_path, "door").area == pytest.approx(2.1)
    assert mesh(tmp_path, "window").area == pytest.approx(2 * 1.3)
    assert mesh(tmp_path, "brick_wall").area == pytest.approx(32 * 3 - 2.1 - 2.6)
    together = trimesh.util.concatenate([mesh(tmp_path, name) for name in ("door", "window", "brick_wall")])
    together.merge_vertices()
    _, uses = np.unique(np.sort(together.edges, axis=1), axis=0, return_counts=True)
    # Only the lower and the upper rim are open: with the corners of door and window, 8 edges each.
    assert (uses == 1).sum() == 2 * 8
    assert set(uses) == {1, 2}


@pytest.mark.parametrize("first", [True, False])
def test_a_door_of_any_name_replaces_the_wall(tmp_path, first):
    types = {"tuer": SurfaceMaterial("tuer", "wood", 0.04)}
    door = line(2, 0, 3, 0, "tuer", 0.0, 2.1)
    make_plan_scene([door, *OUTER] if first else [*OUTER, door], tmp_path, types, lids=())
    assert mesh(tmp_path, "tuer").area == pytest.approx(2.1)
    assert mesh(tmp_path, "brick_wall").area == pytest.approx(32 * 3 - 2.1)


def test_a_type_may_be_a_number(tmp_path):
    plan = tmp_path / "plan.csv"
    plan.write_text("x0,y0,x1,y1,type\n0,0,4,0,1\n4,0,4,3,2\n")
    assert [segment.kind for segment in read_plan(plan)] == ["1", "2"]


def test_types_become_materials(tmp_path):
    plan = [*OUTER, line(3, 0, 3, 6, "drywall"), line(5, 0, 5, 6, "brick", thickness=0.1)]
    types = {"drywall": SurfaceMaterial("drywall", "plasterboard", 0.09)}
    made = make_plan_scene(plan, tmp_path, types, lids=("floor",))
    materials = read_scene(made.path, 5e9).materials
    assert {name: material.thickness for name, material in materials.items()} == {
        "brick_wall_120mm": 0.12, "brick_wall_100mm": 0.1, "drywall": 0.09, "floor": 0.2,
    }  # fmt: skip
    with pytest.raises(InputError, match=r"no material for 'brik'; .*--material brik=concrete; .*'brick'"):
        make_plan_scene([line(0, 0, 1, 0, "brik")], tmp_path)


@pytest.mark.parametrize(("kind", "fault"), [("wood door", "no material"), ("brick", "encloses no area")])
def test_messages_about_a_plan_name_its_file(tmp_path, kind, fault):
    file = tmp_path / "Grundriß EG.csv"
    file.write_text(f"x0,y0,x1,y1,type\n0,0,4,0,{kind}\n")
    with pytest.raises(InputError, match=re.escape(f"floor plan {file}: {fault}")):
        make_plan_scene(read_plan(file), tmp_path / "scene")


def test_a_plan_of_unusual_size_asks_for_its_unit(tmp_path, caplog):
    path = tmp_path / "plan.csv"
    path.write_text("x0,y0,x1,y1,type\n0,0,1000,0,brick\n1000,0,1000,700,brick\n")
    read_plan(path, unit=0.01)
    assert not caplog.messages
    read_plan(path)
    read_plan(path, unit=0.001)
    assert [message.partition("is ")[2].partition(";")[0] for message in caplog.messages] == [
        "1000 m wide",
        "1 m wide",
    ]


def test_a_plan_is_read_in_its_unit(tmp_path):
    path = tmp_path / "plan.csv"
    path.write_text(
        "x0,y0,x1,y1,type,thickness,height,bottom\n0,0,4000,0,Brick,115,,\n0,0,900,0,door,,2000,\n0,0,0,500,glass,,,1000\n"
    )
    assert read_plan(path, height=2.5, unit=0.001) == [
        Segment((0, 0), (4, 0), "brick", 0.0, 2.5, 0.115),
        Segment((0, 0), (0.9, 0), "door", 0.0, 2.0, None),
        Segment((0, 0), (0, 0.5), "glass", 1.0, 2.5, None),
    ]


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("\ufeffX1;Y1;X2;Y2;Material;width_cm\n0;0;4,5;0;Brick;11,5\n", 1.0),
        ("Survey of 4 May\nx0 [cm];y0 [cm];x1 [cm];y1 [cm];Typ;Dicke [mm]\n0;0;450;0;brick;115\n", 1.0),
        ("x0,y0,x1,y1,type,thickness_m\n0,0,4500,0,brick,0.115\n", 0.001),
        ("start_x\tstart_y\tend_x\tend_y\ttype\tthickness\nm\tm\tm\tm\t-\tcm\n0\t0\t4.5\t0\tbrick\t11.5\n", 1.0),
    ],
)  # fmt: skip
def test_a_table_of_walls_is_read_as_surveyors_write_it(tmp_path, text, unit):
    (tmp_path / "plan.csv").write_text(text, encoding="utf-8")
    assert read_plan(tmp_path / "plan.csv", unit=unit) == [
        Segment((0, 0), (4.5, 0), "brick", 0.0, 3.0, pytest.approx(0.115))
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column 'x0'"),
        ("x0,y0,x1,y1\n0,0,1,1\n", "no column 'type'"),
        ("x0,y0,x1,y1,type\n", "contains no segment"),
        ("x0,y0,x1,y1,type\n0,0,a,1,brick\n", "row 2: x1 = 'a' is not a number"),
        ("x0,y0,x1,y1,type\n0,0,,1,brick\n", "row 2: has no type or lacks a coordinate"),
        ("wkt,type\nLINE,brick\n", "row 2: wkt = 'LINE' is not a geometry"),
        ("wkt,type\nPOINT (1 1),brick\n", "row 2: has no type or lacks a coordinate"),
        ("x0,y0,x1,y1,type\n0,0,1,1,brick\n2,2,2,2,brick\n", "row 3: its length, height"),
        ("x0,y0,x1,y1,type,height\n0,0,1,1,brick,-2\n", "row 2: its length, height"),
    ],
)
def test_bad_plans_are_refused(tmp_path, text, message):
    path = tmp_path / "plan.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_plan(path)
    # A device such as /dev/full has no end and is not read.
    for name in (tmp_path / "nowhere.csv", tmp_path, "/dev/full"):
        with pytest.raises(InputError, match="is not a file; check the path"):
            read_plan(name)


@pytest.mark.parametrize(
    "lines",
    [[(0, 0, 5, 0)], [(0, 0, 5, 0), (6, 0, 9, 0)], [(0, 0, 5, 5), (5, 5, 9, 9)]],
    ids=["one wall", "in line", "oblique"],
)
def test_a_plan_that_encloses_no_area_has_no_floor(tmp_path, lines):
    walls = [line(*ends) for ends in lines]
    with pytest.raises(InputError, match=r"encloses no area.*--no-floor --no-ceiling"):
        make_plan_scene(walls, tmp_path / "with")
    made = make_plan_scene(walls, tmp_path / "without", lids=())
    assert made.bounds[5] == 3.0


@pytest.mark.parametrize("height", [np.nan, np.inf, 1e300, -1.0])
def test_a_senseless_height_of_a_plan_is_refused(tmp_path, height):
    (tmp_path / "plan.csv").write_text("x0,y0,x1,y1,type\n0,0,4,0,brick\n")
    with pytest.raises(InputError, match=r"height = .*: must be greater than 0 and at most 1000 m"):
        read_plan(tmp_path / "plan.csv", height)


@pytest.mark.parametrize(
    "row",
    [
        "0,0," + "9" * 30 + ",0,brick,,",
        "0,0,1e20,0,brick,,",
        "0,0,4,0,brick,1e20,",
        "0,0,4,0,brick,,1e6",
        "0,0,60000,0,brick,,",
    ],
)
def test_walls_of_impossible_size_are_refused(tmp_path, row):
    (tmp_path / "plan.csv").write_text(f"x0,y0,x1,y1,type,thickness,height\n{row}\n")
    with pytest.raises(
        InputError, match=r"row 2: .*must be at most 50000 m from the origin, 1000 m high and thick"
    ):
        read_plan(tmp_path / "plan.csv")


def test_storeys_above_each_other_need_their_own_floors(tmp_path):
    def storey(bottom):
        ends = [(0, 0, 10, 0), (10, 0, 10, 6), (10, 6, 0, 6), (0, 6, 0, 0)]
        return [line(*each, bottom=bottom, top=bottom + 2.6) for each in ends]

    with pytest.raises(InputError, match=r"a storey begins at 2\.8 m, .* make a separate scene of each"):
        make_plan_scene([*storey(0.0), *storey(2.8)], tmp_path)
    make_plan_scene([*storey(0.0), *storey(2.8)], tmp_path, lids=())
    parapet = [line(2, 2, 8, 2, top=1.0), line(2, 2, 8, 2, kind="glass", bottom=1.0)]
    make_plan_scene([*OUTER, *parapet], tmp_path)


@pytest.mark.parametrize(("thickness", "stated"), [(24, "24"), (0.0001, "0.0001")])
def test_a_thickness_in_another_unit_is_refused(tmp_path, thickness, stated):
    plan = tmp_path / "plan.csv"
    plan.write_text(f"x0,y0,x1,y1,type,thickness\n0,0,5,0,brick,{thickness}\n")
    with pytest.raises(
        InputError, match=rf"row 2: thickness = {stated} m, but must be 0\.0005 to 3 m; state its unit"
    ):
        read_plan(plan)
    plan.write_text("x0,y0,x1,y1,type,thickness_cm\n0,0,5,0,brick,24\n")
    assert read_plan(plan)[0].thickness == pytest.approx(0.24)


@pytest.mark.parametrize("ending", ["csv.gz", "csv.zip", "csv.xz", "csv.zst", "csv.bz2", "tar"])
@pytest.mark.parametrize(
    "content", [gzip.compress(b"x0,y0,x1,y1,type\n" + b"\0" * 10**7), b"text", b"\0\xff"]
)
def test_a_compressed_plan_is_refused_without_decompressing_it(tmp_path, ending, content):
    (tmp_path / f"plan.{ending}").write_bytes(content)
    with pytest.raises(InputError, match=r"not UTF-8 text|no column"):
        read_plan(tmp_path / f"plan.{ending}")


def test_a_number_of_400_digits_is_refused(tmp_path):
    (tmp_path / "plan.csv").write_text(f"x0,y0,x1,y1,type\n0,0,{'9' * 400},0,brick\n0,0,4,0,brick\n")
    with pytest.raises(InputError, match=r"row 2: x1 = 999.*\.\.\..*999 is not a number"):
        read_plan(tmp_path / "plan.csv")


def drawn(folder: Path, **attributes: object) -> Path:
    """A GeoJSON file of two labels and one wall with these attributes."""
    line = {"type": "LineString", "coordinates": [[0, 0], [5, 0]]}
    label = {"type": "Point", "coordinates": [1, 1]}
    shapes = [({"type": "label"}, label), ({"type": "label"}, label), ({"type": "brick", **attributes}, line)]
    features = [{"type": "Feature", "properties": names, "geometry": shape} for names, shape in shapes]
    path = folder / "plan.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def test_units_in_the_names_of_a_vector_files_attributes_count(tmp_path):
    (wall,) = read_plan(drawn(tmp_path, thickness_cm=24, height_m=4.5, Bottom_mm=500), unit=0.5)
    assert (wall.thickness, wall.bottom, wall.top) == pytest.approx((0.24, 0.5, 5.0))
    assert wall.length == pytest.approx(2.5)
    # A door is as wide as it is drawn: its width is no thickness.
    assert read_plan(drawn(tmp_path, width=0.9))[0].thickness is None


@pytest.mark.parametrize("thickness", [9.0, "thick"])
def test_a_feature_is_named_by_its_number_in_the_file(tmp_path, thickness):
    with pytest.raises(InputError, match=r"plan.geojson, feature 3: thickness = "):
        read_plan(drawn(tmp_path, thickness=thickness))


@pytest.mark.parametrize("columns", ["thickness,thickness_cm", "height,Height [m]"])
def test_two_columns_of_one_meaning_are_refused(tmp_path, columns):
    path = tmp_path / "plan.csv"
    path.write_text(f"x0,y0,x1,y1,type,{columns}\n0,0,5,0,brick,3,3\n")
    with pytest.raises(InputError, match="and another column both state"):
        read_plan(path)


def test_thicknesses_less_than_a_millimetre_apart_are_two_materials(tmp_path):
    """4.5 inches and 11.45 cm; a difference of rounding is one material."""
    widths = [0.1143, 0.1143 + 1e-12, 0.1145, 0.1145]
    walls = [replace(wall, thickness=width) for wall, width in zip(OUTER, widths, strict=True)]
    made = make_plan_scene(walls, tmp_path / "scene", lids=(), merge=False)
    materials = read_scene(made.path, 3.5e9).materials
    assert {name: item.thickness for name, item in materials.items()} == {
        "brick_wall_114_3mm": 0.1143, "brick_wall_114_5mm": 0.1145
    }  # fmt: skip
