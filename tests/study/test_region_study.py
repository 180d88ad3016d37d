"""A study with a region of extra loss, from its file to predictions."""

import json
from itertools import pairwise

import numpy as np
import pytest

import planted
from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.errors import InputError
from calibray.measurements import links_from_frame
from calibray.reporting.wording import scene_alone_text
from calibray.study import Setup, Study

TREES = "region:trees.specific_attenuation"
BOX = [5.0, -10.0, 15.0, 10.0]
REGIONS = {"trees": {"boxes": [BOX], "top": 8.0, "specific_attenuation": 0.3, "maximum_db": 40.0}}
PARAMETERS = {"marble.relative_permittivity": {"bounds": planted.BOUNDS}, TREES: {"bounds": [0.0, 3.0]}}
TRUTH = np.array([planted.TRUTH["marble.relative_permittivity"], 0.9])
FEW = {"name": "auto", "options": {"starts": 16}}


def study(folder, **sections):
    changes = {"regions": REGIONS, "parameters": PARAMETERS, "method": FEW, **sections}
    return planted.study(folder, planted.links(), **changes)


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    return Setup.open(study(tmp_path_factory.mktemp("regions")), links=links_from_frame(planted.links()))


@pytest.fixture(scope="module")
def engine(opened):
    return engines.make(opened)


def test_the_length_in_the_region_is_that_of_the_paths(opened, engine):
    (effect,) = opened.effects(engine.paths)
    paths = engine.paths
    share = (np.arange(4000) + 0.5) / 4000
    for number in range(0, paths.num_paths, 7):
        link = paths.link[number]
        inner = paths.vertex[paths.first[number] : paths.first[number + 1]]
        nodes = np.vstack([paths.tx_position[link], inner, paths.rx_position[link]])
        length = 0.0
        for start, end in pairwise(nodes):
            point = start + share[:, None] * (end - start)
            inside = (point[:, 0] > 5) & (point[:, 0] < 15) & (np.abs(point[:, 1]) < 10) & (point[:, 2] < 8)
            length += np.mean(inside & (point[:, 2] > 0)) * np.linalg.norm(end - start)
        assert effect.length[number] == pytest.approx(length, abs=0.05)
    assert effect.length.max() > 9.0


def test_a_planted_attenuation_is_found_and_used_for_predictions(tmp_path, engine):
    noise = 0.2 * np.random.default_rng(4).standard_normal(planted.LINKS)
    table = planted.links().assign(path_loss_db=engine.path_loss(TRUTH[None])[0] + noise)
    plan = planted.study(tmp_path, table, regions=REGIONS, parameters=PARAMETERS, method=FEW)
    result = calibrate(plan)
    assert result.parameters[TREES] == pytest.approx(0.9, abs=0.1)
    assert result.intervals[TREES].contains(0.9)
    assert "region:trees" not in result.materials
    result.save(tmp_path / "out")
    loaded = Result.load(tmp_path / "out")
    assert loaded.predict(planted.links()) == pytest.approx(result.links.after_db.to_numpy(), abs=1e-6)
    # The exported scene has no trees, and the result says how much that changes.
    difference = result.links.after_db - result.links.scene_db
    assert difference.max() > 5.0
    assert "a scene cannot contain the region trees" in scene_alone_text(result)
    fixed = planted.study(
        tmp_path,
        table,
        regions=REGIONS,
        parameters={key: PARAMETERS[key] for key in PARAMETERS if key != TREES},
    )
    assert calibrate(fixed).rmse_db > result.rmse_db + 0.3


def test_a_file_of_polygons_gives_the_same_as_a_box(tmp_path, opened, engine):
    west, south, east, north = BOX
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    feature = {
        "type": "Feature",
        "properties": {"h": 8.0},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }
    content = {"type": "FeatureCollection", "features": [feature]}
    (tmp_path / "trees.geojson").write_text(json.dumps(content))
    section = {"file": "trees.geojson", "position": "scene", "top": "h", "specific_attenuation": 0.3}
    other = Setup.open(study(tmp_path, regions={"trees": section}), links=links_from_frame(planted.links()))
    (effect,), (expected,) = other.effects(engine.paths), opened.effects(engine.paths)
    assert effect.length == pytest.approx(expected.length)
    assert effect.maximum_db == pytest.approx(1.15 * 3500**0.43)
    assert str(tmp_path / "trees.geojson") in other.files


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"regions": {}}, r"no \[regions\.trees\]"),
        ({"regions": {"trees": REGIONS["trees"] | {"boxes": []}}}, "file or by boxes"),
        ({"regions": {"trees": REGIONS["trees"] | {"boxes": [[5, 0, 1, 2]]}}}, "west less than east"),
        ({"regions": {"trees": REGIONS["trees"] | {"bottom": 9.0}}}, "must be less than top"),
        ({"regions": {"trees": REGIONS["trees"] | {"top": "h"}}}, "columns need a file"),
        ({"engine": {"name": "retrace"}}, "needs engine.name = 'replay'"),
        ({"engine": {"name": "replay", "compress_db": 0.1}}, "compress_db"),
        ({"parameters": {"region:trees.colour": {"bounds": [0, 1]}}}, "no field 'colour'"),
        ({"parameters": {TREES: {"bounds": [0, 1], "start": "itu:wood"}}}, "give a number"),
        ({"parameters": {TREES: {"bounds": [-1, 1]}}}, "must be"),
    ],
)
def test_impossible_regions_are_refused(tmp_path, sections, message):
    with pytest.raises(InputError, match=message):
        study(tmp_path, **sections)


def test_files_and_columns_that_cannot_be_used_are_named(tmp_path):
    section = {"file": "trees.geojson", "top": "h", "specific_attenuation": 0.3}
    with pytest.raises(InputError, match=r"regions\.trees\.file"):
        study(tmp_path, regions={"trees": section}).check_files()
    point = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [1, 2]}}
    (tmp_path / "trees.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [point]}))
    opened = Setup.open(study(tmp_path, regions={"trees": section}), links=links_from_frame(planted.links()))
    with pytest.raises(InputError, match="none of its 1 features is a polygon"):
        opened.effects(planted.engine().paths)


def test_a_study_without_regions_has_no_effects():
    plain = Setup.open(
        Study.from_content(planted.content("links.csv")), links=links_from_frame(planted.links())
    )
    assert plain.effects(planted.engine().paths) == ()
