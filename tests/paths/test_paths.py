"""Path programs: files, their faults, and selecting and joining paths."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import synthetic
from calibray import write_rays
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.materials import FIELDS
from calibray.paths import (
    FORMAT_VERSION,
    Diffraction,
    Diffuse,
    Kind,
    Paths,
    concatenate,
    join_links,
    seal,
    take,
    take_links,
)
from calibray.paths.file_format import BLOCK, DATASETS

DOCUMENT = Path(__file__).parents[2] / "docs" / "reference" / "path-file.md"
FLOATS = [name for name, entry in DATASETS.items() if entry.kind == "f"]
SEQUENCES = st.lists(st.lists(st.sampled_from(Kind), max_size=4), max_size=8)


@pytest.fixture(autouse=True)
def _files_are_read_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most files of these tests are damaged and sealed again; `test_validation.py` tests the process they get."""
    monkeypatch.setattr("calibray.paths.file_format.validate", lambda *_: None)


@pytest.fixture
def paths() -> Paths:
    return synthetic.program(synthetic.EVERY_KIND)


def assert_equal(one: Paths | Diffuse | Diffraction, other: Paths | Diffuse | Diffraction) -> None:
    """Every field equal, in value, shape and type."""
    for entry in fields(one):
        a, b = getattr(one, entry.name), getattr(other, entry.name)
        if isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b, err_msg=entry.name, strict=True)
        elif isinstance(a, Diffuse | Diffraction):
            assert_equal(a, b)
        else:
            assert a == b, entry.name


# Files


@settings(max_examples=30)
@given(sequences=SEQUENCES, seed=st.integers(0, 99), ports=st.sampled_from([(1, 1), (2, 1), (2, 2)]))
def test_a_saved_program_is_loaded_unchanged(
    tmp_path_factory: pytest.TempPathFactory, sequences: list[list[Kind]], seed: int, ports: tuple[int, int]
) -> None:
    saved = synthetic.program(sequences, seed, ports=ports)
    file = tmp_path_factory.mktemp("paths") / "paths.h5"
    saved.save(file)
    assert_equal(Paths.load(file), saved)


def test_a_full_disk_is_noticed_before_the_library_writes(
    paths: Paths, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a full disk, HDF5 prints tracebacks and crashes at the end of the process."""
    full = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr("calibray.support.output_files.shutil.disk_usage", lambda _: full)
    for write in (lambda: paths.save(tmp_path / "a.h5"), lambda: write_rays(paths, tmp_path / "rays.h5")):
        with pytest.raises(InputError, match=r"cannot be written .*No space left"):
            write()
    assert not list(tmp_path.glob("*.h5*"))


def test_materials_and_settings_keep_their_types(paths: Paths, tmp_path: Path) -> None:
    paths.save(tmp_path / "paths.h5")
    loaded = Paths.load(tmp_path / "paths.h5")
    assert list(loaded.materials) == list(paths.materials)  # `material` counts in this order
    assert loaded.settings == paths.settings
    assert {key: type(value) for key, value in loaded.settings.items()} == {
        "samples": int,
        "refraction": bool,
        "scene": str,
    }


def test_a_trace_whose_last_round_reached_a_new_link_is_loaded(paths: Paths, tmp_path: Path) -> None:
    changed_without_limit = replace(paths, settings={"last_round_db": np.inf})
    changed_without_limit.save(tmp_path / "paths.h5")
    assert Paths.load(tmp_path / "paths.h5").settings == {"last_round_db": np.inf}


def test_saving_again_replaces_the_file_and_leaves_no_other(paths: Paths, tmp_path: Path) -> None:
    file = tmp_path / "paths.h5"
    paths.save(file)
    less = take(paths, np.array([0]))
    less.save(str(file))
    assert_equal(Paths.load(str(file)), less)
    assert [entry.name for entry in tmp_path.iterdir()] == ["paths.h5"]


def datasets(file: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Shape and type of every dataset of a file."""
    shape_and_type = {}

    def collect(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            shape_and_type[name] = item.shape, item.dtype

    with h5py.File(file) as content:
        content.visititems(collect)
    return shape_and_type


def test_file_has_only_types_that_matlab_reads(paths: Paths, tmp_path: Path) -> None:
    """Text and numbers, without complex or compound types."""
    paths.save(tmp_path / "paths.h5")
    for name, (_, dtype) in datasets(tmp_path / "paths.h5").items():
        assert dtype.kind in "iuf" or h5py.check_string_dtype(dtype), name


def test_fields_can_be_rebuilt_from_the_bare_file(paths: Paths, tmp_path: Path) -> None:
    paths.save(tmp_path / "paths.h5")
    with h5py.File(tmp_path / "paths.h5") as file:
        field = file["paths/tx_field_real"][()] + 1j * file["paths/tx_field_imag"][()]
        names = [name.decode() for name in file["materials/name"]]
        permittivity = dict(zip(names, file["materials/relative_permittivity"][()], strict=True))
        assert file.attrs["frequency_hz"] == paths.frequency
    np.testing.assert_array_equal(field, paths.tx_field)
    assert permittivity == {
        name: material.relative_permittivity for name, material in paths.materials.items()
    }


def test_document_names_every_dataset_with_its_shape_and_type(paths: Paths, tmp_path: Path) -> None:
    paths.save(tmp_path / "paths.h5")
    rows = re.findall(r"^\| `([^`]+)` \| ([^|]+) \| ([^|]+) \|", DOCUMENT.read_text(), re.MULTILINE)
    documented = {name: (shape.strip(), kind.strip()) for name, shape, kind in rows}
    shape_and_type = datasets(tmp_path / "paths.h5")
    assert set(documented) == set(shape_and_type)
    sizes = {
        "L": paths.num_links, "P": paths.num_paths, "P + 1": paths.num_paths + 1, "I": paths.num_interactions,
        "M": len(paths.materials), "D": len(paths.diffuse.solid_angle), "W": len(paths.diffraction.distance),
        "T": 1, "R": 1,
    }  # fmt: skip
    for name, (shape, kind) in documented.items():
        expected = tuple(sizes.get(axis) or int(axis) for axis in shape.split(" x "))
        assert shape_and_type[name][0] == expected, name
        assert (
            (kind == "text")
            if h5py.check_string_dtype(shape_and_type[name][1])
            else (kind == str(shape_and_type[name][1]))
        ), name


def test_document_names_every_attribute_and_the_version(paths: Paths, tmp_path: Path) -> None:
    paths.save(tmp_path / "paths.h5")
    text = DOCUMENT.read_text()
    assert f"version {FORMAT_VERSION}" in text
    with h5py.File(tmp_path / "paths.h5") as file:
        for name in file.attrs:
            assert f"`{name}`" in text or name.startswith("setting_"), name


# Faults of files


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.h5: does not exist; .*calibray trace"):
        Paths.load(tmp_path / "absent.h5")


@pytest.mark.parametrize("content", [b"", b"paths", b"\x89HDF\r\n\x1a\n" + bytes(100)])
def test_file_that_is_no_hdf5(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "paths.h5").write_bytes(content)
    with pytest.raises(InputError, match=r"paths\.h5: .*(damaged|checksum)"):
        Paths.load(tmp_path / "paths.h5")
    if content.startswith(b"\x89"):
        seal(tmp_path / "paths.h5")
        with pytest.raises(InputError, match=r"paths\.h5: .*damaged"):
            Paths.load(tmp_path / "paths.h5")


def test_truncated_file(paths: Paths, tmp_path: Path) -> None:
    file = tmp_path / "paths.h5"
    paths.save(file)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(InputError, match=r"paths\.h5: .*damaged"):
        Paths.load(file)


@contextmanager
def changed(file: Path) -> Iterator[h5py.File]:
    """A path file to change on purpose; it is sealed again at the end."""
    with h5py.File(file, "a") as content:
        yield content
    seal(file)


def test_hdf5_file_of_another_kind(tmp_path: Path) -> None:
    with changed(tmp_path / "other.h5") as file:
        file["x"] = [1.0]
    with pytest.raises(InputError, match=r"other\.h5: is not a Calibray path file"):
        Paths.load(tmp_path / "other.h5")


def test_other_version_of_the_format(paths: Paths, tmp_path: Path) -> None:
    paths.save(tmp_path / "paths.h5")
    with changed(tmp_path / "paths.h5") as file:
        file.attrs["version"] = FORMAT_VERSION + 1
    with pytest.raises(
        InputError,
        match=rf"version {FORMAT_VERSION + 1} of the format, but must have version {FORMAT_VERSION}; trace again",
    ):
        Paths.load(tmp_path / "paths.h5")


def test_changed_file_is_refused_until_it_is_sealed(paths: Paths, tmp_path: Path) -> None:
    file = tmp_path / "paths.h5"
    paths.save(file)
    with h5py.File(file, "a") as content:
        content["paths/delay"][0] *= 2
    with pytest.raises(
        InputError, match=r"paths\.h5: is damaged \(the checksum does not match\); trace again"
    ):
        Paths.load(file)
    seal(file)
    assert Paths.load(file).delay[0] == 2 * paths.delay[0]


def test_file_without_a_checksum_is_refused_until_it_is_sealed(paths: Paths, tmp_path: Path) -> None:
    file = tmp_path / "paths.h5"
    paths.save(file)
    file.write_bytes(file.read_bytes()[BLOCK:])
    with pytest.raises(InputError, match=r"paths\.h5: has no checksum; trace again, or .*seal"):
        Paths.load(file)
    seal(file)
    assert_equal(Paths.load(file), paths)


def test_only_hdf5_files_are_sealed(tmp_path: Path) -> None:
    (tmp_path / "links.csv").write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match=r"links\.csv: is not an HDF5 file"):
        seal(tmp_path / "links.csv")
    with pytest.raises(InputError, match=r"absent\.h5: cannot be sealed"):
        seal(tmp_path / "absent.h5")
    assert (tmp_path / "links.csv").read_text() == "x,y\n1,2\n"


def test_flipped_bits_and_truncation_are_noticed(paths: Paths, tmp_path: Path) -> None:
    file = tmp_path / "paths.h5"
    paths.save(file)
    content, random = file.read_bytes(), np.random.default_rng(7)
    damaged = [content[:cut] for cut in random.integers(len(content), size=60)] + [
        content + b"\0",
        content + content,
    ]
    for position in [*range(0, BLOCK, 3), *random.integers(len(content), size=300).tolist()]:
        flipped = bytearray(content)
        flipped[position] ^= 1 << int(random.integers(8))
        damaged.append(bytes(flipped))
    for damaged_content in damaged:
        file.write_bytes(damaged_content)
        with pytest.raises(InputError, match=r"paths\.h5: (is damaged|has no checksum)"):
            Paths.load(file)


@pytest.mark.parametrize(
    ("integer", "number"),
    [("uint64", "float32"), ("uint8", "longdouble"), (">i4", ">f8"), (">u8", "float16")],
)
def test_numbers_of_other_types_and_byte_orders_are_read(
    paths: Paths, tmp_path: Path, integer: str, number: str
) -> None:
    paths.save(tmp_path / "paths.h5")
    with changed(tmp_path / "paths.h5") as file:
        for name, entry in DATASETS.items():
            if entry.kind != "O" and name != "paths/delay":  # half precision rounds it by many wavelengths
                values = file[name][()]
                del file[name]
                file[name] = values.astype(integer if entry.kind == "i" else number)
    loss = path_loss(Paths.load(tmp_path / "paths.h5"), combining="coherent")
    np.testing.assert_allclose(loss, path_loss(paths, combining="coherent"), atol=0.1)


@pytest.mark.parametrize("name", list(DATASETS))
def test_missing_misshapen_or_mistyped_dataset(paths: Paths, tmp_path: Path, name: str) -> None:
    file = tmp_path / "paths.h5"
    for fault in ("missing", "shorter", "deeper", "typed"):
        paths.save(file)
        with changed(file) as content:
            values = content[name][()]
            del content[name]
            if fault == "shorter":
                content[name] = values[:-1]
            elif fault == "deeper":
                content[name] = values[None]
            elif fault == "typed":
                content[name] = (
                    values.astype(float) if values.dtype.kind in "iu" else np.zeros(values.shape, int)
                )
        with pytest.raises(InputError, match=r"paths\.h5: .*trace again"):
            Paths.load(file)


@pytest.mark.parametrize(("name", "index", "value"), [
    *((name, 0, value) for name in FLOATS for value in (np.nan, np.inf, -np.inf)),
    ("paths/link", -1, 2), ("paths/link", 0, -1), ("paths/link", 0, 1), ("paths/first", 0, 1),
    ("paths/first", -1, 10**12), ("paths/first", 1, 5), ("paths/first", 3, -1), ("interactions/kind", 0, 3),
    ("interactions/kind", 0, 0), ("interactions/kind", 0, Kind.DIFFUSE), ("interactions/material", 0, 3),
    ("interactions/material", 0, -1), ("interactions/cos_incidence", 0, 1.1),
    ("interactions/cos_incidence", 0, -0.5), ("diffuse/cos_scattered", 0, -0.5),
    ("diffraction/cos_incidence_n", 0, -0.5),
    ("interactions/rotation", 0, 0.5), ("paths/delay", 0, -1e-9), ("paths/spreading", 0, -1.0),
    ("diffuse/solid_angle", 0, -1.0), ("diffraction/sin_edge", 0, 1.5), ("diffraction/sin_edge", 0, 0.0),
    ("diffraction/exterior_angle", 0, 0.0), ("paths/departure", 0, 7.0),
    ("materials/relative_permittivity", 0, 0.5), ("materials/name", 0, "glass"), ("materials/name", 0, ""),
    ("materials/scattering_pattern", 0, "shiny"), ("paths/tx_field_real", 0, 1e300), ("paths/rx_field_imag", 0, -1e300),
    ("paths/delay", 0, 1e300), ("paths/spreading", 0, 1e300), ("links/rx_position", 0, 1e300),
    ("diffuse/solid_angle", 0, 1e300), ("diffraction/distance", 0, 1e300),
])  # fmt: skip
def test_value_that_no_trace_can_have(
    paths: Paths, tmp_path: Path, name: str, index: int, value: float | str
) -> None:
    """Refused although the checksum agrees, because the file was sealed with a wrong value."""
    paths.save(tmp_path / "paths.h5")
    with changed(tmp_path / "paths.h5") as file:
        file[name][index] = value
    with pytest.raises(InputError, match=r"paths\.h5: "):
        Paths.load(tmp_path / "paths.h5")


@pytest.mark.parametrize("frequency", [0.0, -1e9, 3.5, 1e15, np.nan, np.inf, "1e9", True, [1e9]])
def test_impossible_carrier(paths: Paths, tmp_path: Path, frequency: object) -> None:
    paths.save(tmp_path / "paths.h5")
    with changed(tmp_path / "paths.h5") as file:
        file.attrs["frequency_hz"] = frequency
    with pytest.raises(InputError, match=r"paths\.h5: .*frequency_hz"):
        Paths.load(tmp_path / "paths.h5")


def test_dataset_outside_the_file_is_not_read(paths: Paths, tmp_path: Path) -> None:
    """A link into another file, and a size that was never written."""
    for name in ("other.h5", "paths.h5"):
        paths.save(tmp_path / name)
    with changed(tmp_path / "paths.h5") as file:
        del file["paths/delay"]
        file["paths/delay"] = h5py.ExternalLink("other.h5", "/paths/delay")
    with pytest.raises(InputError, match="no dataset paths/delay"):
        Paths.load(tmp_path / "paths.h5")
    with changed(tmp_path / "paths.h5") as file:
        del file["paths/delay"]
        file.create_dataset("paths/delay", shape=(10**14,), dtype=float, chunks=(10**3,))
    with pytest.raises(InputError, match="not stored contiguously"):
        Paths.load(tmp_path / "paths.h5")


@pytest.mark.parametrize("name", ["version", "frequency_hz"])
def test_missing_attribute(paths: Paths, tmp_path: Path, name: str) -> None:
    paths.save(tmp_path / "paths.h5")
    with changed(tmp_path / "paths.h5") as file:
        del file.attrs[name]
    with pytest.raises(InputError, match=r"paths\.h5: .*trace again"):
        Paths.load(tmp_path / "paths.h5")


@pytest.mark.parametrize("target", ["absent/paths.h5", "file/paths.h5", "folder"])
def test_target_that_cannot_be_written(paths: Paths, tmp_path: Path, target: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"output file .*(there is no folder|is a folder)"):
        paths.save(tmp_path / target)
    assert sorted(entry.name for entry in tmp_path.rglob("*")) == ["file", "folder"]


def test_a_user_s_file_or_link_is_not_replaced(paths: Paths, tmp_path: Path) -> None:
    """Not under the name of the file, nor under a name that the unfinished file might have."""
    precious = tmp_path / "precious.txt"
    precious.write_text("years of work")
    for name in ("paths.h5.part", "paths.h5.partial", "paths.h5.tmp"):
        (tmp_path / name).symlink_to(precious)
    paths.save(tmp_path / "paths.h5")
    assert Paths.load(tmp_path / "paths.h5") is not None
    (tmp_path / "link.h5").symlink_to(precious)
    with pytest.raises(InputError, match="is a symbolic link"):
        paths.save(tmp_path / "link.h5", overwrite=True)
    with pytest.raises(InputError, match="was not written by Calibray"):
        paths.save(precious)
    assert precious.read_text() == "years of work"
    assert not (tmp_path / ".calibray").exists()  # path files have a seal
    paths.save(precious, overwrite=True)
    assert Paths.load(precious) is not None


def test_writers_of_one_file_do_not_mix(paths: Paths, tmp_path: Path) -> None:
    """The file of the writer that ends last remains, whole."""
    file = tmp_path / "paths.h5"
    with ThreadPoolExecutor(4) as pool:
        for saved in [pool.submit(paths.save, file) for _ in range(16)]:
            saved.result()
    assert len(Paths.load(file).delay) == len(paths.delay)
    assert [entry.name for entry in tmp_path.iterdir()] == ["paths.h5"]


# Selecting and joining


def path_record(paths: Paths, path: int) -> dict[str, object]:
    """All constants of one path and its interactions."""
    interactions = range(paths.first[path], paths.first[path + 1])
    record = {
        name: getattr(paths, name)[path].tolist()
        for name in ("delay", "spreading", "departure", "arrival", "tx_field", "rx_field")
    }
    record["ends"] = [
        paths.tx_position[paths.link[path]].tolist(),
        paths.rx_position[paths.link[path]].tolist(),
    ]
    for index in interactions:
        record[f"interaction {index - paths.first[path]}"] = [
            getattr(paths, name)[index].tolist()
            for name in ("kind", "material", "cos_incidence", "rotation", "vertex")
        ]
        for kind, table in ((Kind.DIFFUSE, paths.diffuse), (Kind.DIFFRACTION, paths.diffraction)):
            if paths.kind[index] == kind:
                row = int((paths.kind[:index] == kind).sum())
                record[f"table row {index - paths.first[path]}"] = [
                    getattr(table, entry.name)[row].tolist() for entry in fields(table)
                ]
    return record


@pytest.mark.parametrize("index", [[7, 6, 4, 4, 2], []])
def test_taken_paths_keep_their_constants(paths: Paths, index: list[int]) -> None:
    taken = take(paths, np.array(index))
    assert taken.num_paths == len(index)
    assert [path_record(taken, path) for path in range(len(index))] == [
        path_record(paths, path) for path in index
    ]


def test_all_paths_taken_are_the_program_itself(paths: Paths) -> None:
    assert_equal(take(paths, np.arange(paths.num_paths)), paths)


def test_a_mask_takes_what_its_numbers_take(paths: Paths) -> None:
    deep = np.diff(paths.first) > 1
    assert 0 < deep.sum() < len(deep)
    assert_equal(take(paths, deep), take(paths, np.flatnonzero(deep)))
    last = np.arange(paths.num_links) > 0
    assert_equal(take_links(paths, last), take_links(paths, np.flatnonzero(last)))


def test_links_taken_in_another_order_keep_their_paths(paths: Paths) -> None:
    order = np.array([1, 0, 1])
    taken = take_links(paths, order)
    expected = [path_record(paths, path) for link in order for path in np.flatnonzero(paths.link == link)]
    assert [path_record(taken, path) for path in range(taken.num_paths)] == expected
    assert_equal(join_links([(np.array([1, 0]), take_links(paths, np.array([1, 0])))]), paths)


def test_joined_programs_keep_all_paths_in_the_order_of_links(paths: Paths) -> None:
    odd = np.arange(paths.num_paths) % 2 == 1
    joined = concatenate([take(paths, np.flatnonzero(chosen)) for chosen in (odd, ~odd)])
    assert (np.diff(joined.link) >= 0).all()

    def records(program: Paths) -> list[str]:
        return sorted(repr(path_record(program, path)) for path in range(program.num_paths))

    assert records(joined) == records(paths)


@given(sequences=SEQUENCES, seed=st.integers(0, 9))
def test_joining_programs_in_link_order_keeps_all_arrays(sequences: list[list[Kind]], seed: int) -> None:
    whole = synthetic.program(sequences, seed, links=3)
    parts = [take(whole, np.flatnonzero(whole.link == link)) for link in range(3)]
    assert_equal(concatenate(parts), whole)
    assert_equal(concatenate(parts[::-1]), whole)


def test_links_without_a_path_are_listed(paths: Paths) -> None:
    assert paths.links_without_path.tolist() == []
    assert replace(paths, link=np.ones_like(paths.link)).links_without_path.tolist() == [0]


def test_material_table_replaces_materials_by_name(paths: Paths) -> None:
    table = paths.material_table()
    glass = replace(paths.materials["glass"], thickness=0.004)
    changed = paths.material_table({"glass": glass})
    assert changed[1, FIELDS.index("thickness")] == 0.004
    assert (changed != table).sum() == 1
    with pytest.raises(
        InputError, match="no material 'steel' in the traced scene, which has walls, glass, ground"
    ):
        paths.material_table({"steel": glass})
    with pytest.raises(
        InputError, match="'walls': scattering_pattern 'directive' differs from 'lambertian' in the trace"
    ):
        paths.material_table({"walls": glass})


# Summary


def test_summary_fits_a_terminal_and_has_all_counts(paths: Paths) -> None:
    paths = replace(paths, link=np.zeros_like(paths.link))
    kinds = {kind.name.lower(): int((paths.kind == kind).sum()) for kind in Kind}
    assert min(kinds.values()) > 0
    for summary in (repr(paths), paths._repr_html_()):
        for text in (
            "2, 1 without a path",
            f"{paths.num_paths}",
            f"{paths.num_interactions}: ",
            *(f"{count} {name}" for name, count in kinds.items()),
            ", ".join(paths.materials),
            f"{paths.frequency / 1e9:g} GHz",
            " KiB",
        ):
            assert text in summary
    lines = repr(paths).splitlines()
    assert len(lines) == 7
    assert max(map(len, lines)) <= 80


def test_summary_shortens_many_materials_and_escapes_their_names(paths: Paths) -> None:
    material = next(iter(paths.materials.values()))
    names = ["<b>", *(f"material-number-{k}" for k in range(200))]
    odd = replace(paths, materials=dict.fromkeys(names, material))
    assert max(map(len, repr(odd).splitlines())) <= 80
    assert "201: <b>, material-number-0" in repr(odd)
    assert "&lt;b&gt;" in odd._repr_html_()


@pytest.mark.parametrize(("count", "text"), [(8, "64 B"), (1 << 17, "1.0 MiB"), (3 << 27, "3.0 GiB")])
def test_summary_has_the_size_of_all_arrays(paths: Paths, count: int, text: str) -> None:
    empty = take(paths, np.zeros(0, dtype=int))
    held = sum(part.nbytes for part in (empty.tx_position, empty.rx_position, empty.first))
    wide = replace(
        empty, delay=np.broadcast_to(0.0, count), tx_position=empty.tx_position[:0], first=empty.first[:0],
        rx_position=empty.rx_position[:0],
    )  # fmt: skip
    assert held > 0
    assert repr(wide).splitlines()[-1].split(maxsplit=1)[1] == text
