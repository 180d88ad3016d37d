"""Floor plans: faces merged into sheets, walls that meet, doors in walls, floors; bad plans are refused."""

from __future__ import annotations

import gzip
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
    sheets, merged = merge_faces([*OUTER, *ROOMS])
    assert merged == 12
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

    sheets, _ = merge_faces([rotated(segment) for segment in [*OUTER, *ROOMS]])
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
    assert merge_faces([line(0, 0, 4, 0), other])[1] == (2 if merges else 0)


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
    make_plan_scene(plan, tmp_path, floor=False, ceiling=False)
    assert mesh(tmp_path, "door").area == pytest.approx(2.1)
    assert mesh(tmp_path, "window").area == pytest.approx(2 * 1.3)
    assert mesh(tmp_path, "brick_wall").area == pytest.approx(32 * 3 - 2.1 - 2.6)
    together = trimesh.util.concatenate([mesh(tmp_path, name) for name in ("door", "window", "brick_wall")])
    together.merge_vertices()
    _, uses = np.unique(np.sort(together.edges, axis=1), axis=0, return_counts=True)
    # Only the lower and the upper rim are open: with the corners of door and window, 8 edges each.
    assert (uses == 1).sum() == 2 * 8
    assert set(uses) == {1, 2}


def test_types_become_materials(tmp_path):
    plan = [*OUTER, line(3, 0, 3, 6, "drywall"), line(5, 0, 5, 6, "brick", thickness=0.1)]
    types = {"drywall": SurfaceMaterial("drywall", "plasterboard", 0.09)}
    made = make_plan_scene(plan, tmp_path, types, ceiling=False)
    materials = read_scene(made.path, 5e9).materials
    assert {name: material.thickness for name, material in materials.items()} == {
        "brick_wall_120mm": 0.12, "brick_wall_100mm": 0.1, "drywall": 0.09, "floor": 0.2,
    }  # fmt: skip
    with pytest.raises(InputError, match="type 'brik': has no material; did you mean 'brick'"):
        make_plan_scene([line(0, 0, 1, 0, "brik")], tmp_path)


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
    ("text", "message"),
    [
        ("", "is not a table"),
        ("x0,y0,x1,y1\n0,0,1,1\n", "no column 'type'"),
        ("x0,y0,x1,y1,type\n", "holds no segment"),
        ("x0,y0,x1,y1,type\n0,0,a,1,brick\n", "row 2: x1 = 'a' is not a number"),
        ("x0,y0,x1,y1,type\n0,0,,1,brick\n", "row 2: lacks its type or a coordinate"),
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
    made = make_plan_scene(walls, tmp_path / "without", floor=False, ceiling=False)
    assert made.bounds[5] == 3.0


@pytest.mark.parametrize("height", [np.nan, np.inf, 1e300, -1.0])
def test_a_senseless_height_of_a_plan_is_refused(tmp_path, height):
    (tmp_path / "plan.csv").write_text("x0,y0,x1,y1,type\n0,0,4,0,brick\n")
    with pytest.raises(InputError, match=r"height = .*: must be a number of metres greater than 0"):
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
        InputError, match=r"row 2: .*coordinates may be 50000 m, heights and thicknesses 1000 m"
    ):
        read_plan(tmp_path / "plan.csv")


@pytest.mark.parametrize("ending", ["csv.gz", "csv.zip", "csv.xz", "csv.zst", "csv.bz2", "tar"])
@pytest.mark.parametrize(
    "content", [gzip.compress(b"x0,y0,x1,y1,type\n" + b"\0" * 10**7), b"text", b"\0\xff"]
)
def test_a_compressed_plan_is_refused_without_decompressing_it(tmp_path, ending, content):
    (tmp_path / f"plan.{ending}").write_bytes(content)
    with pytest.raises(InputError, match=r"is not a table|no column"):
        read_plan(tmp_path / f"plan.{ending}")


def test_a_number_of_400_digits_is_refused(tmp_path):
    (tmp_path / "plan.csv").write_text(f"x0,y0,x1,y1,type\n0,0,{'9' * 400},0,brick\n0,0,4,0,brick\n")
    with pytest.raises(InputError, match=r"row 2: x1 = 999.*\.\.\..*999 is not a number"):
        read_plan(tmp_path / "plan.csv")
