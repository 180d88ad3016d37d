"""Path programs: files that give back what was saved, faults told, and paths taken out and joined."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import synthetic
from calibray.errors import InputError
from calibray.fields import path_gains, path_loss
from calibray.paths import SCHEMA_VERSION, Diffraction, Diffuse, Kind, Paths, concatenate, take

DOCUMENT = Path(__file__).parents[1] / "docs" / "path-file.md"
SEQUENCES = st.lists(st.lists(st.sampled_from(Kind), max_size=4), max_size=8)


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


@given(sequences=SEQUENCES, seed=st.integers(0, 99), ports=st.sampled_from([(1, 1), (2, 1), (2, 2)]))
def test_what_was_saved_is_loaded(
    tmp_path_factory: pytest.TempPathFactory, sequences: list[list[Kind]], seed: int, ports: tuple[int, int]
) -> None:
    saved = synthetic.program(sequences, seed, ports=ports)
    file = tmp_path_factory.mktemp("paths") / "paths.h5"
    saved.save(file)
    assert_equal(Paths.load(file), saved)


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


def test_saving_again_replaces_the_file_and_leaves_nothing_beside_it(paths: Paths, tmp_path: Path) -> None:
    file = tmp_path / "paths.h5"
    paths.save(file)
    less = take(paths, np.array([0]))
    less.save(str(file))
    assert_equal(Paths.load(str(file)), less)
    assert [entry.name for entry in tmp_path.iterdir()] == ["paths.h5"]


def datasets(file: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Shape and type of every dataset of a file."""
    found = {}

    def note(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item.shape, item.dtype

    with h5py.File(file) as content:
        content.visititems(note)
    return found


def test_file_holds_only_what_matlab_reads_too(paths: Paths, tmp_path: Path) -> None:
    """Numbers without complex or compound types, and text."""
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
    found = datasets(tmp_path / "paths.h5")
    assert set(documented) == set(found)
    sizes = {
        "L": paths.num_links, "P": paths.num_paths, "P + 1": paths.num_paths + 1, "I": paths.num_interactions,
        "M": len(paths.materials), "D": len(paths.diffuse.solid_angle), "W": len(paths.diffraction.distance),
        "T": 1, "R": 1,
    }  # fmt: skip
    for name, (shape, kind) in documented.items():
        expected = tuple(sizes.get(axis) or int(axis) for axis in shape.split(" x "))
        assert found[name][0] == expected, name
        assert (
            (kind == "text") if h5py.check_string_dtype(found[name][1]) else (kind == str(found[name][1]))
        ), name


def test_document_names_every_attribute_and_the_version(paths: Paths, tmp_path: Path) -> None:
    paths.save(tmp_path / "paths.h5")
    text = DOCUMENT.read_text()
    assert f"version {SCHEMA_VERSION}" in text
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
    with pytest.raises(InputError, match=r"paths\.h5: .*damaged"):
        Paths.load(tmp_path / "paths.h5")


def test_truncated_file(paths: Paths, tmp_path: Path) -> None:
    file = tmp_path / "paths.h5"
    paths.save(file)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(InputError, match=r"paths\.h5: .*damaged"):
        Paths.load(file)


def test_hdf5_file_of_another_kind(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = [1.0]
    with pytest.raises(InputError, match=r"other\.h5: is no Calibray path file"):
        Paths.load(tmp_path / "other.h5")


def test_other_schema_version(paths: Paths, tmp_path: Path) -> None:
    paths.save(tmp_path / "paths.h5")
    with h5py.File(tmp_path / "paths.h5", "a") as file:
        file.attrs["version"] = SCHEMA_VERSION + 1
    with pytest.raises(
        InputError, match=rf"version {SCHEMA_VERSION + 1}, need {SCHEMA_VERSION}; trace again"
    ):
        Paths.load(tmp_path / "paths.h5")


@pytest.mark.parametrize(
    "name", ["paths/delay", "materials/name", "diffuse/solid_angle", "paths/tx_field_imag"]
)
def test_missing_dataset(paths: Paths, tmp_path: Path, name: str) -> None:
    paths.save(tmp_path / "paths.h5")
    with h5py.File(tmp_path / "paths.h5", "a") as file:
        del file[name]
    with pytest.raises(InputError, match=r"paths\.h5: .*trace again"):
        Paths.load(tmp_path / "paths.h5")


@pytest.mark.parametrize("name", ["version", "frequency_hz"])
def test_missing_attribute(paths: Paths, tmp_path: Path, name: str) -> None:
    paths.save(tmp_path / "paths.h5")
    with h5py.File(tmp_path / "paths.h5", "a") as file:
        del file.attrs[name]
    with pytest.raises(InputError, match=r"paths\.h5: .*trace again"):
        Paths.load(tmp_path / "paths.h5")


@pytest.mark.parametrize("target", ["absent/paths.h5", "file/paths.h5", "folder"])
def test_place_that_cannot_be_written(paths: Paths, tmp_path: Path, target: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"cannot be written.*; name a file in a writable folder"):
        paths.save(tmp_path / target)
    assert sorted(entry.name for entry in tmp_path.rglob("*")) == ["file", "folder"]


# Taking paths out and joining programs


def test_taken_paths_keep_their_gains(paths: Paths) -> None:
    gains = path_gains(paths)
    for index in ([7, 6, 4, 4, 2], []):
        np.testing.assert_allclose(path_gains(take(paths, np.array(index))), gains[index], rtol=1e-12)


def test_all_paths_taken_are_the_program_itself(paths: Paths) -> None:
    assert_equal(take(paths, np.arange(paths.num_paths)), paths)


def test_split_program_joins_to_itself(paths: Paths) -> None:
    odd = np.arange(paths.num_paths) % 2 == 1
    parts = [take(paths, np.flatnonzero(chosen)) for chosen in (odd, ~odd)]
    joined = concatenate(parts)
    assert (np.diff(joined.link) >= 0).all()
    np.testing.assert_allclose(path_loss(joined), path_loss(paths), rtol=1e-12)
    np.testing.assert_allclose(
        np.sort_complex(path_gains(joined)), np.sort_complex(path_gains(paths)), rtol=1e-12
    )


@given(sequences=SEQUENCES, seed=st.integers(0, 9))
def test_joining_programs_in_link_order_keeps_all_arrays(sequences: list[list[Kind]], seed: int) -> None:
    whole = synthetic.program(sequences, seed, links=3)
    parts = [take(whole, np.flatnonzero(whole.link == link)) for link in range(3)]
    assert_equal(concatenate(parts), whole)
    assert_equal(concatenate(parts[::-1]), whole)


def test_links_without_a_path_are_listed_and_infinitely_weak(paths: Paths) -> None:
    none = replace(paths, link=np.full(paths.num_paths, 1, dtype=np.int32))
    assert none.links_without_path.tolist() == [0]
    loss = path_loss(none)
    assert np.isposinf(loss[0])
    assert np.isfinite(loss[1])


# What a screen shows


def test_paths_fit_a_screen_and_say_what_matters(paths: Paths) -> None:
    paths = replace(paths, link=np.zeros_like(paths.link))
    kinds = {kind.name.lower(): int((paths.kind == kind).sum()) for kind in Kind}
    assert min(kinds.values()) > 0
    for shown in (repr(paths), paths._repr_html_()):
        for text in (
            "2, 1 of them without a path",
            f"{paths.num_paths}",
            f"{paths.num_interactions}: ",
            *(f"{count} {name}" for name, count in kinds.items()),
            ", ".join(paths.materials),
            f"{paths.frequency / 1e9:g} GHz",
            " KiB",
        ):
            assert text in shown
    lines = repr(paths).splitlines()
    assert len(lines) == 7
    assert max(map(len, lines)) <= 80


def test_many_and_odd_names_of_materials_are_shown_in_part_and_as_text(paths: Paths) -> None:
    material = next(iter(paths.materials.values()))
    names = ["<b>", *(f"material-number-{k}" for k in range(200))]
    odd = replace(paths, materials=dict.fromkeys(names, material))
    assert max(map(len, repr(odd).splitlines())) <= 80
    assert "201: <b>, material-number-0" in repr(odd)
    assert "&lt;b&gt;" in odd._repr_html_()


@pytest.mark.parametrize(("count", "text"), [(8, "64 B"), (1 << 17, "1.0 MiB"), (3 << 27, "3.0 GiB")])
def test_memory_is_that_of_all_arrays(paths: Paths, count: int, text: str) -> None:
    empty = take(paths, np.zeros(0, dtype=int))
    held = sum(part.nbytes for part in (empty.tx_position, empty.rx_position, empty.first))
    wide = replace(
        empty, delay=np.broadcast_to(0.0, count), tx_position=empty.tx_position[:0], first=empty.first[:0],
        rx_position=empty.rx_position[:0],
    )  # fmt: skip
    assert held > 0
    assert repr(wide).splitlines()[-1].split(maxsplit=1)[1] == text
