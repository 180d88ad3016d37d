"""Scene files: materials as Sionna reads them, faults named with file and remedy, and scenes exported."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import sionna.rt

import calibray as cb
from calibray.errors import InputError
from calibray.materials import ITU_MATERIALS, SCALAR_CONSTANTS, Material, itu_law, itu_material
from calibray.scenes import export_scene, read_scene
from calibray.support.output_files import SIGNATURES
from small_scenes import CONCRETE, block, write_scene

SCENES = Path(sionna.rt.__file__).parent / "scenes"
BUNDLED = sorted(folder.name for folder in SCENES.iterdir() if (folder / f"{folder.name}.xml").is_file())
FLOOR = {"floor": [[(-9.0, -9.0, 0.0), (9.0, -9.0, 0.0), (9.0, 9.0, 0.0), (-9.0, 9.0, 0.0)]]}
ITU = '<bsdf type="itu-radio-material" id="mat-stone"><string name="type" value="{}"/></bsdf>'


def test_bundled_scenes_are_found() -> None:
    assert {"munich", "etoile", "florence", "san_francisco", "simple_street_canyon", "box"} <= set(BUNDLED)


@pytest.mark.parametrize("name", BUNDLED)
def test_constants_equal_sionnas(name: str, tmp_path: Path) -> None:
    """Compared with the materials that Sionna itself reads, with one mesh for each, since all meshes take long."""
    root = ElementTree.parse(SCENES / name / f"{name}.xml").getroot()
    seen = set()
    for shape in root.findall("shape"):
        material = shape.find("ref").get("id")
        if material in seen:
            root.remove(shape)
            continue
        seen.add(material)
        filename = shape.find("string[@name='filename']")
        filename.set("value", str(SCENES / name / filename.get("value")))
    ElementTree.ElementTree(root).write(tmp_path / "bare.xml")
    theirs = sionna.rt.load_scene(str(tmp_path / "bare.xml"), merge_shapes=False)
    theirs.frequency = 3.5e9
    ours = read_scene(tmp_path / "bare.xml", 3.5e9).materials
    assert set(ours) == set(theirs.radio_materials)
    for key, material in ours.items():
        for field in SCALAR_CONSTANTS:
            value = getattr(theirs.radio_materials[key], field)[0]
            assert getattr(material, field) == pytest.approx(value, rel=1e-6), (key, field)


def test_all_meshes_of_a_bundled_scene_are_read() -> None:
    assert len(read_scene("sionna:etoile", 3.5e9).objects) == 565


def test_objects_and_materials_are_in_the_files_order() -> None:
    scene = read_scene("sionna:box_one_screen", 1e9)
    assert [(entry.name, entry.material) for entry in scene.objects] == [
        ("box", "box-mat"),
        ("screen", "screen-mat"),
    ]
    assert list(scene.materials) == ["box-mat", "screen-mat"]


# Materials of other files


@pytest.mark.parametrize("bsdf", [
    ITU.format("concrete"),
    '<bsdf type="twosided" id="mat-itu_concrete"><bsdf type="diffuse"/></bsdf>',
    '<bsdf type="radio-material" id="mat-itu_concrete"/>',
])  # fmt: skip
def test_itu_materials_are_named_by_type_or_by_id(tmp_path: Path, bsdf: str) -> None:
    identifier = re.search('id="(.*?)"', bsdf)[1]
    scene = read_scene(write_scene(tmp_path, FLOOR, bsdf, identifier), 2e9)
    assert scene.materials == {identifier.removeprefix("mat-"): itu_material("concrete", 2e9, thickness=0.1)}


def test_constants_are_read_from_the_file(tmp_path: Path) -> None:
    bsdf = CONCRETE.replace("</bsdf>", '<float name="scattering_coefficient" value="0.3"/></bsdf>')
    scene = read_scene(write_scene(tmp_path, FLOOR, bsdf), 2e9)
    assert scene.materials == {"stone": Material(5.0, 0.05, 0.2, 0.3)}


def test_overrides_replace_constants(tmp_path: Path) -> None:
    file = write_scene(tmp_path, FLOOR)

    def stone(override: Material | dict[str, object]) -> Material:
        return read_scene(file, 2e9, {"stone": override}).materials["stone"]

    assert stone({"thickness": 0.4}) == Material(5.0, 0.05, 0.4)
    assert stone({"itu": "glass"}) == itu_material("glass", 2e9, thickness=0.2)
    assert stone({"itu": "glass", "revision": "P.2040-1", "thickness": 0.01}) == itu_material(
        "glass", 2e9, thickness=0.01, revision="P.2040-1"
    )
    assert stone(Material(2.0, 0.0, 0.1)) == Material(2.0, 0.0, 0.1)
    assert stone({"scattering_pattern": "directive", "alpha_r": 3}).scattering_pattern == "directive"


def test_a_revision_alone_applies_to_the_material_of_the_file(tmp_path: Path) -> None:
    file = write_scene(tmp_path, FLOOR, ITU.format("concrete"))
    name = next(iter(read_scene(file, 2e9).materials))
    scene = read_scene(file, 2e9, {name: {"revision": "P.2040-1"}})
    assert scene.materials[name] == itu_material("concrete", 2e9, thickness=0.1, revision="P.2040-1")
    assert scene.laws[name] == itu_law("concrete", 2e9, "P.2040-1")


# Faults


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<scene><bsdf", r"is not well-formed XML \(.*line 1.*\); export it again"),
        ("", r"is not well-formed XML"),
        ("\x00\x01", r"is not well-formed XML"),
        ("<html/>", r"the root element is <html>, but must be <scene>"),
        ("<scene/>", r"the scene has no <shape>"),
    ],
)
def test_a_file_that_is_not_a_scene_is_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "scene.xml").write_text(content)
    with pytest.raises(InputError, match=message) as refusal:
        read_scene(tmp_path / "scene.xml", 2e9)
    assert str(tmp_path / "scene.xml") in str(refusal.value)


def test_a_binary_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="is not well-formed XML"):
        read_scene(tmp_path / "scene.xml", 2e9)


@pytest.mark.parametrize("name", ["absent.xml", "."])
def test_a_missing_file_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="does not exist; check the path"):
        read_scene(tmp_path / name, 2e9)


def test_an_unknown_bundled_scene_is_refused() -> None:
    with pytest.raises(InputError, match=r"'sionna:munch'.*choose one of .*munich"):
        read_scene("sionna:munch", 2e9)


def test_a_missing_mesh_is_refused(tmp_path: Path) -> None:
    file = write_scene(tmp_path, FLOOR)
    (tmp_path / "meshes" / "floor.ply").unlink()
    with pytest.raises(
        InputError, match=r"mesh 'meshes/floor.ply' of shape 'mesh-floor' does not exist in .*; copy"
    ):
        read_scene(file, 2e9)


def test_a_compressed_mesh_is_refused(tmp_path: Path) -> None:
    file = write_scene(tmp_path, FLOOR)
    file.write_text(file.read_text().replace('"ply"', '"serialized"'))
    with pytest.raises(InputError, match=r"scene\.xml: shape 'mesh-floor' is a 'serialized', .* PLY mesh"):
        read_scene(file, 2e9)


@pytest.mark.parametrize(
    ("step", "sound"),
    [
        ('<scale value="0"/>', False),
        ('<scale x="3" y="0" z="1"/>', False),
        ('<scale value="nan"/>', False),
        ('<translate x="inf"/>', False),
        ('<rotate z="1" angle="north"/>', False),
        ('<matrix value="1 0 0 0 0 1 0 0 0 0 0 0 0 0 0 1"/>', False),
        ('<matrix value="1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1"/>', True),
        ('<scale x="3" y="-2"/><rotate z="1" angle="30"/><translate x="0" y="4"/>', True),
    ],
)
def test_a_transform_that_flattens_a_shape_is_refused(tmp_path: Path, step: str, sound: bool) -> None:
    file = write_scene(tmp_path, FLOOR)
    placed = f'<shape type="rectangle" id="mesh-sheet"><transform name="to_world">{step}</transform>'
    file.write_text(
        file.read_text().replace("<shape", f'{placed}<ref id="mat-stone" name="bsdf"/></shape><shape', 1)
    )
    if sound:
        assert read_scene(file, 2e9).materials
        return
    with pytest.raises(InputError, match=r"of shape 'mesh-sheet' is .*do not flatten the shape"):
        read_scene(file, 2e9)


def test_a_shape_without_a_material_is_refused(tmp_path: Path) -> None:
    file = write_scene(tmp_path, FLOOR, material="mat-other")
    with pytest.raises(
        InputError, match=r"shape 'mesh-floor' refers to no <bsdf> of the scene; give it a material"
    ):
        read_scene(file, 2e9)


def test_a_material_without_radio_constants_needs_an_override(tmp_path: Path) -> None:
    file = write_scene(tmp_path, FLOOR, '<bsdf type="diffuse" id="mat-stone"/>')
    with pytest.raises(
        InputError, match=r"material 'stone': its BSDF of type 'diffuse' has no radio constants; give"
    ):
        read_scene(file, 2e9)
    given = {"stone": {"relative_permittivity": 3.0, "conductivity": 0.1}}
    assert read_scene(file, 2e9, given).materials["stone"] == Material(3.0, 0.1, 0.1)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("relative_permittivity", "0.5", r"relative_permittivity = 0\.5: must be"),
        ("thickness", "0", r"thickness = 0\.0: must be"),
        ("conductivity", "much", r"conductivity = 'much': must be a finite number"),
        ("conductivity", "nan", r"conductivity = nan: must be"),
    ],
)
def test_constants_out_of_bounds_are_refused(tmp_path: Path, field: str, value: str, message: str) -> None:
    bsdf = re.sub(rf'name="{field}" value="[^"]*"', f'name="{field}" value="{value}"', CONCRETE)
    with pytest.raises(InputError, match=rf"material 'stone': {message}"):
        read_scene(write_scene(tmp_path, FLOOR, bsdf), 2e9)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            {"stonne": {"thickness": 0.1}},
            r"\[materials\] stonne: the scene has no material 'stonne'; did you mean 'stone'\?",
        ),
        ({"stone": {"tickness": 0.1}}, r"\[materials\] stone: unknown key 'tickness'"),
        ({"stone": {"thickness": -1.0}}, r"material 'stone': thickness = -1\.0: must be"),
        (
            {"stone": {"itu": "concret"}},
            r"material 'stone': 'concret' is not a material .*did you mean 'concrete'\?",
        ),
        (
            {"stone": {"itu": "glass", "revision": "P.2040-9"}},
            r"material 'stone': revision = 'P\.2040-9': unknown",
        ),
    ],
)
def test_bad_overrides_are_refused(tmp_path: Path, overrides: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_scene(write_scene(tmp_path, FLOOR), 2e9, overrides)


@pytest.mark.parametrize("frequency", [0.5e9, 150e9])
def test_a_frequency_outside_the_itu_range_needs_constants(tmp_path: Path, frequency: float) -> None:
    """NVlabs/sionna-rt#71: Sionna itself refuses the scene before the constants can be given."""
    file = write_scene(tmp_path, FLOOR, ITU.format("concrete"))
    with pytest.raises(InputError, match=r"material 'stone': .*concrete.*1.*100 GHz"):
        read_scene(file, frequency)
    given = {"stone": {"relative_permittivity": 6.0, "conductivity": 0.2}}
    scene = read_scene(file, frequency, given)
    assert scene.materials["stone"] == Material(6.0, 0.2, 0.1)
    links = SimpleNamespace(tx=np.array([[0.0, 0, 3]]), rx=np.array([[4.0, 0, 2]]))
    paths = cb.trace(scene, links, frequency=frequency, max_depth=1, samples=20_000)
    assert paths.num_paths == 2


# Exported scenes


def links_in_the_canyon() -> SimpleNamespace:
    rx = np.random.default_rng(4).uniform((-8, -8, 1.5), (8, 8, 2.5), (4, 3))
    return SimpleNamespace(tx=np.tile([-20.0, 2, 15], (4, 1)), rx=rx)


def test_an_exported_scene_has_the_same_path_loss(tmp_path: Path) -> None:
    """Calibrated constants in an exported scene, read by Calibray and by Sionna alone."""
    source, frequency, options = "sionna:simple_street_canyon", 3.5e9, {"max_depth": 2, "samples": 20_000}
    links = links_in_the_canyon()
    original = cb.trace(source, links, frequency=frequency, **options)
    new = {
        name: replace(
            material, relative_permittivity=2.0 + index, conductivity=0.1, thickness=0.15 + 0.02 * index
        )
        for index, (name, material) in enumerate(original.materials.items())
    }
    target = tmp_path / "deep" / "calibrated.xml"
    target.parent.mkdir()
    export_scene(read_scene(source, frequency), new, target)
    expected = cb.path_loss(original, new)

    again = cb.trace(target, links, frequency=frequency, **options)
    assert list(again.materials.values()) == list(new.values())
    np.testing.assert_allclose(cb.path_loss(again), expected, atol=1e-3)

    scene = sionna.rt.load_scene(str(target))
    scene.frequency = frequency
    scene.tx_array = scene.rx_array = sionna.rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    scene.add(sionna.rt.Transmitter("tx", links.tx[0].tolist()))
    for index, position in enumerate(links.rx):
        scene.add(sionna.rt.Receiver(f"rx-{index}", position.tolist()))
    paths = sionna.rt.PathSolver(deterministic=True)(
        scene, max_depth=2, refraction=False, samples_per_src=20_000, seed=1
    )
    power = sum(part.numpy() ** 2 for part in paths.a).sum(axis=(1, 2, 3, 4))
    np.testing.assert_allclose(-10 * np.log10(power), expected, atol=0.01)
    assert sorted(path.name for path in target.parent.iterdir()) == [SIGNATURES, "calibrated.xml"]


def test_exported_materials_avoid_names_that_sionna_reserves(tmp_path: Path) -> None:
    target = tmp_path / "out.xml"
    scene = read_scene("sionna:floor_wall", 3.5e9)
    assert set(scene.materials) <= set(ITU_MATERIALS["P.2040-3"])
    export_scene(scene, scene.materials, target)
    assert set(read_scene(target, 3.5e9).materials) == {f"calibrated-{name}" for name in scene.materials}


def test_an_exported_scene_finds_its_meshes_from_another_folder(tmp_path: Path) -> None:
    file = write_scene(tmp_path / "here", {"house": block((-1, -1, 0), (1, 1, 2)), **FLOOR})
    (tmp_path / "there").mkdir()
    export_scene(read_scene(file, 1e9), {"stone": Material(3.0, 0.2, 0.1)}, tmp_path / "there" / "scene.xml")
    scene = read_scene(tmp_path / "there" / "scene.xml", 1e9)
    assert scene.materials == {"stone": Material(3.0, 0.2, 0.1)}
    assert [entry.name for entry in scene.objects] == ["house", "floor"]


def test_export_needs_every_material(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no constants for the material 'brick'"):
        export_scene(
            read_scene("sionna:floor_wall", 3.5e9),
            {"concrete": Material(3.0, 0.2, 0.1)},
            tmp_path / "scene.xml",
        )
    assert not list(tmp_path.iterdir())


# Shapes and names


@pytest.mark.parametrize(
    "element",
    [
        '<texture type="bitmap"></texture>',
        '<texture type="bitmap"><string name="filename" value="wood.png"/></texture>',
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>',
        '<sensor type="perspective"><float name="fov" value="$fov"/></sensor><integrator type="path"/>',
        '<medium type="heterogeneous" id="fog"/>',
    ],
)
def test_what_has_no_effect_on_radio_waves_does_not_reach_the_tracer(tmp_path: Path, element: str) -> None:
    """A texture without a file ended the process."""
    file = write_scene(tmp_path, FLOOR)
    plain = read_scene(file, 2e9)
    file.write_text(
        file.read_text().replace("<bsdf", f"{element}<bsdf", 1).replace("<ref", f"{element}<ref", 1)
    )
    assert read_scene(file, 2e9).xml == plain.xml


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"ply"', '"sphere"', "shape 'mesh-floor' is a 'sphere', but must be one of cube, obj, ply"),
        ('"ply"', '"shapegroup"', "is a 'shapegroup', but must be one of"),
        ('type="ply"', "", "is a '', but must be one of"),
        ('<string name="filename" value="meshes/floor.ply"/>', "", "shape 'mesh-floor' has no filename"),
        ("floor.ply", "f" * 5000 + ".ply", r"mesh 'meshes/ff.*\.\.\..*' of shape 'mesh-floor' does not exist"),
        ("floor.ply", "", "mesh 'meshes/' of shape 'mesh-floor' does not exist"),
        ("floor.ply", "&#0;", "is not well-formed XML"),
        ("<shape", '<include filename="more.xml"/><shape', "<include> is not supported"),
        ("<shape", "<group/><shape", "<group> in the scene is not an element of a radio scene; remove it"),
        ("<shape", '<path value="/etc"/><shape', "<path> in the scene is not an element"),
        ("<ref", '<float name="radius" value="1"/><ref', "<float name='radius'> in shape 'mesh-floor' is not"),
        ("<ref", '<shape type="ply"/><ref', "<shape> in shape 'mesh-floor' is not an element"),
        ("meshes/floor.ply", "$file", r"value = '\$file' in shape 'mesh-floor' is a parameter of the scene"),
        ("<bsdf", CONCRETE.replace("5.0", "6.0") + "<bsdf", "material 'stone' is defined twice"),
        ("<shape", "<a>" * 100 + "</a>" * 100 + "<shape", "nested more than 64 deep"),
        ("<shape", "<a>" * 300_000, "nested more than 64 deep"),
        ("<scene", '<?xml version="1.0" encoding="banana"?><scene', "is not well-formed XML .*unknown encoding"),
        ("<scene", '<?xml version="1.0" encoding="utf-32"?><scene', "is not well-formed XML .*as UTF-8"),
        (
            "<scene",
            '<!DOCTYPE s [<!ENTITY x SYSTEM "file:///dev/zero">]><scene a="&x;"',
            "is not well-formed XML .*external entity",
        ),
        (
            "<scene",
            '<!DOCTYPE s [<!ENTITY a0 "aaaaaaaaaa">'
            + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
            + ']><scene a="&a9;"',
            "is not well-formed XML",
        ),
    ],
    ids=lambda value: value[:20],
)  # fmt: skip
def test_unsupported_scenes_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    file = write_scene(tmp_path, FLOOR)
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=message) as refusal:
        read_scene(file, 2e9)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 1000


@pytest.mark.parametrize("name", ["s" * 5000 + ".xml", "a\0b.xml", "sionna:" + "x" * 5000, "sionna:a\0b"])
def test_impossible_file_names_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=r"does not exist|not bundled with"):
        read_scene(name, 2e9)


def test_a_scene_is_used_at_the_carrier_of_its_constants_only(tmp_path: Path) -> None:
    """Concrete conducts three times as well at 4 GHz as at 1 GHz; constants without a law hold at any carrier."""
    ends = cb.Measurements([[0.0, 0.0, 2.0]], [[30.0, 5.0, 2.0]], [90.0])
    concrete = read_scene("sionna:simple_wedge", 1e9)
    assert concrete.materials["concrete"].conductivity == itu_material("concrete", 1e9).conductivity
    cb.write_rays(cb.trace(concrete, ends, frequency=1e9, samples=10_000), tmp_path / "rays.csv")
    for use in (
        lambda scene: cb.trace(scene, ends, frequency=4e9, samples=10_000),
        lambda scene: cb.read_rays(tmp_path / "rays.csv", scene, frequency=4e9),
    ):
        with pytest.raises(InputError, match="constants are valid only at 1 GHz; read it at 4 GHz"):
            use(concrete)
    free = read_scene("sionna:simple_wedge", 1e9, {"concrete": Material(5.0, 0.1, 0.2)})
    assert free.frequency is None
    free.check_frequency(4e9)
