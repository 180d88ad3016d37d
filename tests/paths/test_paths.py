"""Path programs: files that give back what was saved, faults told, and paths taken out and joined."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
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
from calibray.paths import SCHEMA_VERSION, Diffraction, Diffuse, Kind, Paths, concatenate, seal, take
from calibray.paths.checksum import BLOCK
from calibray.paths.file_format import DATASETS

DOCUMENT = Path(__file__).parents[2] / "docs" / "path-file.md"
FLOATS = [name for name, entry in DATASETS.items() if entry.kind == "f"]
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


def test_a_file_may_lack_the_points_of_interaction(paths: Paths, tmp_path: Path) -> None:
    """Files from before they were kept do; what is joined with such a program lacks them too."""
    without = replace(paths, vertex=None)
    without.save(tmp_path / "paths.h5")
    assert_equal(Paths.load(tmp_path / "paths.h5"), without)
    assert concatenate([paths, without]).vertex is None
    kept = take(paths, np.arange(paths.num_paths)[::-2])
    for path, index in enumerate(np.arange(paths.num_paths)[::-2]):
        np.testing.assert_array_equal(
            kept.vertex[kept.first[path] : kept.first[path + 1]],
            paths.vertex[paths.first[index] : paths.first[index + 1]],
        )


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
    """A path file to be changed on purpose: its checksum agrees again at the end."""
    with h5py.File(file, "a") as content:
        yield content
    seal(file)


def test_hdf5_file_of_another_kind(tmp_path: Path) -> None:
    with changed(tmp_path / "other.h5") as file:
        file["x"] = [1.0]
    with pytest.raises(InputError, match=r"other\.h5: is no Calibray path file"):
        Paths.load(tmp_path / "other.h5")


def test_other_schema_version(paths: Paths, tmp_path: Path) -> None:
    paths.save(tmp_path / "paths.h5")
    with changed(tmp_path / "paths.h5") as file:
        file.attrs["version"] = SCHEMA_VERSION + 1
    with pytest.raises(
        InputError, match=rf"version {SCHEMA_VERSION + 1}, need {SCHEMA_VERSION}; trace again"
    ):
        Paths.load(tmp_path / "paths.h5")


def test_changed_file_is_refused_until_it_is_sealed(paths: Paths, tmp_path: Path) -> None:
    file = tmp_path / "paths.h5"
    paths.save(file)
    with h5py.File(file, "a") as content:
        content["paths/delay"][0] *= 2
    with pytest.raises(
        InputError, match=r"paths\.h5: is damaged \(its checksum does not agree\); trace again"
    ):
        Paths.load(file)
    seal(file)
    assert Paths.load(file).delay[0] == 2 * paths.delay[0]


def test_file_from_before_there_were_seals_is_tried_by_another_process(
    paths: Paths, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flipped bits can hang the HDF5 library and crash it; without a checksum nothing tells beforehand."""
    file = tmp_path / "paths.h5"
    paths.save(file)
    whole = file.read_bytes()[BLOCK:]
    file.write_bytes(whole)
    assert_equal(Paths.load(file), paths)
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"paths\.h5: has no checksum, and is damaged"):
        Paths.load(file)
    file.write_bytes(whole)
    monkeypatch.setattr("calibray.paths.trial.PATIENCE", 0.01)
    with pytest.raises(InputError, match=r"paths\.h5: is damaged \(reading it took more than 0\.01 s\)"):
        Paths.load(file)
    seal(file)
    assert_equal(Paths.load(file), paths)


def test_only_hdf5_files_are_sealed(tmp_path: Path) -> None:
    (tmp_path / "links.csv").write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match=r"links\.csv: is no HDF5 file"):
        seal(tmp_path / "links.csv")
    with pytest.raises(InputError, match=r"absent\.h5: cannot be sealed"):
        seal(tmp_path / "absent.h5")
    assert (tmp_path / "links.csv").read_text() == "x,y\n1,2\n"


def test_every_flipped_bit_and_every_cut_is_noticed(paths: Paths, tmp_path: Path) -> None:
    file = tmp_path / "paths.h5"
    paths.save(file)
    whole, random = file.read_bytes(), np.random.default_rng(7)
    damaged = [whole[:cut] for cut in random.integers(len(whole), size=60)] + [whole + b"\0", whole + whole]
    for place in [*range(0, BLOCK, 3), *random.integers(len(whole), size=300).tolist()]:
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(random.integers(8))
        damaged.append(bytes(flipped))
    for content in damaged:
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"paths\.h5: (is damaged|has no checksum)"):
            Paths.load(file)


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
    ("interactions/rotation", 0, 0.5), ("paths/delay", 0, -1e-9), ("paths/spreading", 0, -1.0),
    ("diffuse/solid_angle", 0, -1.0), ("diffraction/sin_edge", 0, 1.5), ("paths/departure", 0, 7.0),
    ("materials/relative_permittivity", 0, 0.5), ("materials/name", 0, "glass"), ("materials/name", 0, ""),
    ("materials/scattering_pattern", 0, "shiny"), ("paths/tx_field_real", 0, 1e300), ("paths/rx_field_imag", 0, -1e300),
    ("paths/delay", 0, 1e300), ("paths/spreading", 0, 1e300), ("links/rx_position", 0, 1e300),
    ("diffuse/solid_angle", 0, 1e300), ("diffraction/distance", 0, 1e300),
])  # fmt: skip
def test_value_that_no_trace_gives(
    paths: Paths, tmp_path: Path, name: str, index: int, value: float | str
) -> None:
    """Refused although the checksum agrees: who changed the file was wrong."""
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


def test_dataset_from_elsewhere_is_not_read(paths: Paths, tmp_path: Path) -> None:
    """A link into another file, and sizes that were never written."""
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
    with pytest.raises(InputError, match="not stored in one piece"):
        Paths.load(tmp_path / "paths.h5")


@pytest.mark.parametrize("name", ["version", "frequency_hz"])
def test_missing_attribute(paths: Paths, tmp_path: Path, name: str) -> None:
    paths.save(tmp_path / "paths.h5")
    with changed(tmp_path / "paths.h5") as file:
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
