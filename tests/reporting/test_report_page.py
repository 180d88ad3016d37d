"""The report: every section is there, nothing is loaded, names are text, and it says what the data say."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

import calibray as cb
import planted
import synthetic
from calibray.calibration.result import Result
from calibray.errors import InputError
from calibray.paths import Kind
from calibray.reporting import page as reports
from calibray.reporting.link_map import plan, ramp
from calibray.reporting.link_survey import survey
from calibray.reporting.rays import INTERACTIONS, PER_LINK, strongest
from calibray.reporting.scene_mesh import Grid
from calibray.reporting.value_list import values
from calibray.reporting.wording import summary
from calibray.scenes import read_scene, read_triangles
from calibray.scenes.building_outlines import _loops
from calibray.uncertainty.linear_theory import Interval
from changed import changed
from small_scenes import block, write_scene

SECTIONS = {
    "summary", "values", "validation", "figures", "residuals", "links-map", "scene", "diagnostics", "study",
}  # fmt: skip
HOSTILE = "</script><script>hostile()</script>\u2028<img src=x onerror=hostile()>$\\frac&'\""


class Page(HTMLParser):
    """What a browser would find: ids, tags, what is referred to, scripts, and the text that people read."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids, self.references, self.scripts, self.tags, self.words = [], [], [], [], ""
        self._inside: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        given = dict(attrs)
        if "id" in given:
            self.ids.append(given["id"])
        self.references += [
            given[name] for name in ("href", "src", "xlink:href", "action", "data", "srcset") if name in given
        ]
        self.references += re.findall(r"url\(([^)]*)\)", given.get("style") or "")
        if tag in ("script", "style"):
            self._inside.append(tag)
            self.scripts.append("")
        assert not any(name.startswith("on") for name in given), (tag, attrs)

    def handle_endtag(self, tag):
        if tag in ("script", "style"):
            self._inside.pop()

    def handle_data(self, data):
        if self._inside:
            self.scripts[-1] += data
        else:
            self.words += data

    @property
    def data(self):
        return json.loads(self.scripts[-2])


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> Result:
    """A calibration with an offset per half, a hold-out, and a link without a path; the groups have hostile names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", "")
        table = planted.campaign(noise_db=0.3, blocked=True)
        study = planted.study(
            tmp_path_factory.mktemp("study"),
            table.assign(
                path_loss_db=table.path_loss_db.where(np.isfinite(table.path_loss_db), 110.0),
                half=table.half.map({"west": HOSTILE, "east": "east"}),
            ),
            offset={"per": "half"},
            holdout={"where": "rx_x > 10"},
            method={"name": "auto", "options": {"starts": 4, "iterations": 10}},
        )
        return cb.calibrate(study)


@pytest.fixture(scope="module")
def written(result, tmp_path_factory):
    folder = tmp_path_factory.mktemp("out")
    result.save(folder)
    cb.report(result, folder / "report.html", figures=folder / "figures")
    return folder


@pytest.fixture(scope="module")
def found(written) -> Page:
    return Page((written / "report.html").read_text(encoding="utf-8"))


def test_every_section_is_there(found):
    assert set(found.ids) >= SECTIONS
    assert len(found.ids) == len(set(found.ids))
    assert {"figure-convergence", "figure-cumulative-cost", "figure-path-loss", "figure-residual-over-distance",
            "figure-residual-by-group"} <= set(found.ids)  # fmt: skip


def test_nothing_is_loaded_from_anywhere(found, written):
    inner = {f"#{name}" for name in found.ids}
    for reference in found.references:
        assert reference in inner or reference.startswith("data:"), reference
    assert not {"iframe", "object", "embed", "form", "base", "img"} & set(found.tags)
    text = (written / "report.html").read_text(encoding="utf-8")
    assert "://" not in text
    assert "default-src 'none'" in text
    assert not re.search(r"url\((?!#|&#34;#|data:)", "".join(found.scripts[:1]))


def test_hostile_names_are_text(found, result):
    assert HOSTILE in found.words
    assert HOSTILE in found.data["groups"]
    # The page's own three: style, data and viewer.
    assert len(found.scripts) == 3
    assert "\u2028" not in found.scripts[1]


def test_data_of_the_page_are_those_of_the_result(found, result):
    links = found.data["links"]
    table = result.links
    assert links["row"] == table.row.tolist()
    assert links["measured"] == pytest.approx(table.measured_db.tolist(), abs=0.0051)
    after = [np.inf if value is None else value for value in links["after"]]
    assert after == pytest.approx(table.after_db.tolist(), abs=0.0051)
    assert sum(links["held"]) == table.held_out.sum() > 0
    words = " ".join(found.words.split())
    assert f"RMSE is {result.holdout_rmse_db:.2f} dB" in words
    for name, value in result.parameters.items():
        assert name in words
        assert f"{value:.4g}" in words


def test_interaction_points_make_paths_of_the_traced_length(result):
    """The points that are drawn, with the link's ends, add up to each path's delay."""
    paths = result.paths
    for path in range(paths.num_paths):
        link = paths.link[path]
        inner = paths.vertex[paths.first[path] : paths.first[path + 1]].astype(float)
        points = np.concatenate([paths.tx_position[link, None], inner, paths.rx_position[link, None]])
        length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        assert length == pytest.approx(paths.delay[path] * 299_792_458, rel=1e-5)


def test_the_strongest_paths_hold_the_power_of_the_link(result):
    shown = strongest(result.paths, result)
    assert (np.diff(shown.paths.link) >= 0).all()
    for link in np.unique(shown.paths.link):
        own = shown.gain_db[shown.paths.link == link]
        assert (np.diff(own) <= 0).all()
        assert len(own) <= PER_LINK
    # No link of this scene has more paths than are kept, so their power is the link's.
    assert shown.paths.num_paths == shown.traced
    power = np.bincount(shown.paths.link, 10 ** (shown.gain_db / 10), len(result.links))
    reached = power > 0
    offset = np.array([result.nuisance.offsets_db[name] for name in result.links["group"]])
    assert -10 * np.log10(power[reached]) + offset[reached] == pytest.approx(
        result.links.after_db[reached], abs=1e-3
    )
    assert shown.meets["concrete"] > 0
    assert shown.meets["glass"] == 0


def test_of_many_paths_the_strongest_are_shown(result):
    many = synthetic.program([(Kind.SPECULAR,)] * 600, links=2)
    shown = strongest(many, changed(result, materials=many.materials))
    assert np.bincount(shown.paths.link).tolist() == [PER_LINK, PER_LINK]
    gain = 20 * np.log10(np.abs(cb.path_gains(many)))
    for link in range(2):
        best = np.sort(gain[many.link == link])[::-1][:PER_LINK]
        assert shown.gain_db[shown.paths.link == link] == pytest.approx(best)
    assert INTERACTIONS > 24


def test_an_older_result_is_drawn_from_its_study(written, result, tmp_path):
    old = Result.load(written)
    old = changed(old, links=old.links.drop(columns=["tx_x", "group"]))
    links = survey(old)
    assert links.rx == pytest.approx(survey(result).rx)
    assert links.group.tolist() == survey(result).group.tolist()


def test_what_cannot_be_read_any_more_is_said(written, result, monkeypatch, tmp_path):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    gone = Result.load(written)
    content = gone.study.content()
    content["links"]["file"], content["scene"]["file"] = "absent.csv", "absent.xml"
    gone = replace(
        gone, study=cb.Study.from_content(content, "study.toml"), links=gone.links[["row", "measured_db", "before_db",
        "after_db", "log_distance_db", "has_path", "held_out"]],
    )  # fmt: skip
    cb.report(gone, tmp_path / "report.html")
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert set(page.ids) >= SECTIONS
    assert "absent.csv cannot be read any more" in page.words
    assert page.data is None


def test_a_file_that_cannot_be_written_is_refused_before_the_work(result, tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        cb.report(result, tmp_path / "absent" / "report.html")


def test_figures_are_written_as_svg_and_png(written):
    names = {path.name for path in (written / "figures").iterdir() if path.suffix in (".svg", ".png")}
    stems = {
        "convergence",
        "cumulative-cost",
        "path-loss",
        "residual-over-distance",
        "residual-by-group",
        "power",
    }
    assert names >= {f"{stem}.{suffix}" for stem in stems for suffix in ("svg", "png")}
    for path in (written / "figures").glob("*.svg"):
        ElementTree.parse(path)


# Sentences


def said(result: Result, heading: str) -> str:
    parts = summary(result)
    start = next(place for place, part in enumerate(parts) if part.heading == heading)
    end = next((place for place in range(start + 1, len(parts)) if parts[place].heading), len(parts))
    return " ".join(part.text for part in parts[start:end])


HELP = "Did it help where nothing was fitted?"


def judged(result: Result, after: float, before: float, links: int) -> Result:
    """The result with held-out links whose errors are planted, of random sign."""
    random = np.random.default_rng(2)
    measured = np.full(links, 90.0)
    sign = random.choice([-1, 1], links) * random.uniform(0.8, 1.2, links)
    table = pd.DataFrame({
        "row": np.arange(links), "measured_db": measured, "before_db": measured + before * sign,
        "after_db": measured + after * random.permutation(sign), "log_distance_db": measured + 9 * sign,
        "has_path": True, "held_out": True,
    })  # fmt: skip
    return changed(
        result, links=table, holdout_rmse_db=after, initial_holdout_rmse_db=before,
        log_distance_holdout_rmse_db=9.0, nuisance_only_holdout_rmse_db=None,
    )  # fmt: skip


def test_the_summary_says_whether_it_helped(result):
    assert "So it helped" in said(judged(result, 2.0, 4.0, 60), HELP)
    assert "did not beat it" in said(judged(result, 4.0, 3.9, 60), HELP)
    assert "more than chance" in said(judged(result, 3.9, 4.0, 6), HELP)
    assert "So it helped" not in said(judged(result, 3.9, 4.0, 6), HELP)
    rival = changed(judged(result, 2.0, 4.0, 60), log_distance_holdout_rmse_db=1.5)
    assert "a log-distance model with 1.50 dB. Calibration did not beat it" in said(rival, HELP)
    none = changed(result, holdout_rmse_db=None, initial_holdout_rmse_db=None)
    assert "Not known: no links were held out" in said(none, HELP)


def test_the_summary_says_what_the_data_cannot_tell(result):
    verdicts = dict(zip(result.parameters, ("identified", "at bound", "not identifiable"), strict=True))
    known = changed(
        result, intervals={name: Interval(0.1, 2.0, 3.0, verdict) for name, verdict in verdicts.items()}
    )
    sure, _, unsure = verdicts
    text = said(known, "How sure are the values?")
    assert f"The links tell 1 of 3: {sure}" in text
    assert f"{unsure}: not told by these links" in text
    material = unsure.rpartition(".")[0]
    for meets, words in ((0, "no path of any link meets it"), (1, "meet it")):
        parts = summary(known, {material: meets})
        assert any(part.text.startswith(material) and words in part.text for part in parts)
    assert "gives no derivatives" in said(changed(result, intervals={}), "How sure are the values?")


def test_bars_stand_where_the_values_are(result):
    entry = values(changed(result, intervals={}))[0]
    assert entry.pieces == ()
    content = result.study.content()
    name = next(iter(content["parameters"]))
    content["parameters"][name] = {"bounds": [1.0, 100.0], "scale": "log", "start": 10.0}
    logarithmic = changed(
        result, study=cb.Study.from_content(content), parameters=result.parameters | {name: 1000**0.5},
        initial_parameters=result.fit.initial_parameters | {name: 10.0},
        intervals={name: Interval(1.0, 10**0.5, 1000.0, "identified")},
    )  # fmt: skip
    entry = values(logarithmic)[0]
    assert entry.places == pytest.approx({"before": 0.5, "after": 0.75})
    assert entry.pieces[0] == pytest.approx((0.25, 1.0))


# Map and scene


def test_the_map_shows_footprints_where_they_are(tmp_path, result):
    ground = [[(-200, -200, 0), (200, -200, 0), (200, 200, 0), (-200, 200, 0)]]
    quads = {"ground": ground, "house": block((0, 0, 0), (20, 10, 8)), "shed": block((30, 0, 0), (35, 5, 3))}
    scene = read_scene(write_scene(tmp_path, quads), 3.5e9)
    triangles = read_triangles(scene)
    assert triangles.ground.sum() == 2
    assert triangles.left_out == ()
    links = replace(survey(result), tx=np.full((12, 3), 50.0), rx=np.zeros((12, 3)) - 50)
    shown = plan(links, triangles)
    outlines = [
        {tuple(map(float, point.split(","))) for point in outline.split("L")}
        for outline in shown.buildings.removeprefix("M").removesuffix("Z").split("ZM")
    ]
    corners = [[(0, 0), (20, 0), (20, 10), (0, 10)], [(30, 0), (35, 0), (35, 5), (30, 5)]]
    expected = [{tuple(at) for at in shown.place(np.array(each)).round(1).tolist()} for each in corners]
    assert sorted(map(sorted, outlines)) == sorted(map(sorted, expected))


def test_outlines_run_around_faces_that_share_edges():
    assert [sorted(loop) for loop in _loops([[0, 1, 2], [0, 2, 3]])] == [[0, 1, 2, 3]]
    assert sorted(map(len, _loops([[0, 1, 2], [3, 4, 5]]))) == [3, 3]


def test_objects_that_cannot_be_drawn_are_named(tmp_path):
    file = write_scene(
        tmp_path, {"house": block((0, 0, 0), (20, 10, 8)), "broken": block((0, 0, 0), (1, 1, 1))}
    )
    scene = read_scene(file, 3.5e9)
    (tmp_path / "meshes" / "broken.ply").write_text("ply\nnonsense")
    triangles = read_triangles(scene)
    assert triangles.left_out == ("broken",)
    assert len(triangles.face) == 12


def test_colours_part_more_from_less():
    colors = ramp(np.array([-9.0, 0.0, 9.0, np.nan]), 5.0)
    assert colors == ["#1f5fa8", "#a9b4bd", "#b34a00", "none"]


def test_the_grid_keeps_positions():
    points = np.random.default_rng(1).uniform(-800, 1200, (500, 3))
    grid = Grid.over(points)
    assert grid.low + grid.step * grid.steps(points) == pytest.approx(points, abs=0.51 * grid.step)
    assert grid.step < 0.04


def test_measured_power_keeps_its_sign_in_the_links(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    table = planted.campaign(noise_db=0.3)
    power = table.assign(power_dbm=30.0 - table.path_loss_db).drop(columns="path_loss_db")
    sections = planted.content("links.csv")["links"] | {
        "value": "power_dbm", "quantity": "received_power", "tx_power_dbm": 30.0,
    }  # fmt: skip
    study = planted.study(
        tmp_path, power, links=sections, method={"name": "auto", "options": {"starts": 1, "iterations": 2}}
    )
    links = cb.calibrate(study, engine=planted.engine()).links
    assert links.measured_received_power_dbm.to_numpy() == pytest.approx(power.power_dbm)
    assert links.after_received_power_dbm.to_numpy() == pytest.approx(30.0 - links.after_db)
    assert links[["rx_x", "rx_y", "rx_z"]].to_numpy() == pytest.approx(
        power[["rx_x", "rx_y", "rx_z"]].to_numpy()
    )


def test_a_page_that_fails_loses_no_result(written, monkeypatch, tmp_path):
    from typer.testing import CliRunner

    from calibray.cli.app import app

    study = Result.load(written).study
    (tmp_path / "links.csv").write_text((study.path.parent / "links.csv").read_text())
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    monkeypatch.setattr(reports, "page", None)

    def found(*_, out, **__):
        result = Result.load(written)
        result.save(out)
        return result

    monkeypatch.setattr("calibray.calibration.calibrate.calibrate", found)
    file = tmp_path / "study.toml"
    file.write_text(
        'version = 1\nscene = { file = "sionna:simple_street_canyon", frequency = 3.5e9 }\n'
        'links = { file = "links.csv", tx = ["tx_x", "tx_y", "tx_z"], rx = ["rx_x", "rx_y", "rx_z"], '
        'value = "path_loss_db" }\nparameters = { "wood.thickness" = { bounds = [0.1, 0.2] } }\n'
    )
    done = CliRunner().invoke(app, ["run", str(file), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert "Warning: no report" in done.stderr
    assert "calibray report" in done.stderr
    assert Result.load(tmp_path / "out").parameters == Result.load(written).parameters
    assert not (tmp_path / "out" / "report.html").exists()
