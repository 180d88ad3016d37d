"""The report page: sections, embedded data, escaped names, and sentences that agree with the data."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest

import calibray as cb
import planted
import synthetic
from calibray.calibration.result import Result
from calibray.errors import InputError
from calibray.paths import Kind
from calibray.reporting import page as reports
from calibray.reporting import result_tables as tables
from calibray.reporting.figures import path_loss_by_receiver
from calibray.reporting.link_map import plan, ramp
from calibray.reporting.link_survey import in_measured_quantity, survey
from calibray.reporting.result_tables import values
from calibray.reporting.summary import summary
from calibray.reporting.trust_figures import held_out_blocks
from calibray.reporting.viewer import INTERACTIONS, PER_LINK, Grid, strongest
from calibray.reporting.wording import diagnostics_table, group_text
from calibray.result.held_out import HeldOutErrors, Judgement, Model
from calibray.result.verdict import Remark, RemarkKind, Verdict
from calibray.scenes import read_scene, read_triangles
from calibray.scenes.buildings import _loops
from calibray.support.figure_style import plain_number
from calibray.uncertainty.verdicts import Interval, consistent
from calibray.validation.validation import Validation
from changed import changed
from small_scenes import block, write_scene

pytestmark = pytest.mark.usefixtures("own_cache")

SECTIONS = {
    "summary", "values", "validation", "figures", "residuals", "links-map", "scene", "diagnostics", "study",
}  # fmt: skip
HOSTILE = "</script><script>hostile()</script>\u2028<img src=x onerror=hostile()>$\\frac&'\""


class Page(HTMLParser):
    """Ids, tags, references, scripts and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids, self.references, self.scripts, self.tags, self.words = [], [], [], [], ""
        self._inside: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        attributes = dict(attrs)
        if "id" in attributes:
            self.ids.append(attributes["id"])
        self.references += [
            attributes[name]
            for name in ("href", "src", "xlink:href", "action", "data", "srcset")
            if name in attributes
        ]
        self.references += re.findall(r"url\(([^)]*)\)", attributes.get("style") or "")
        if tag in ("script", "style"):
            self._inside.append(tag)
            self.scripts.append("")
        assert not any(name.startswith("on") for name in attributes), (tag, attrs)

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
    """A calibration with an offset per half, held-out links, a link without a path, and a hostile group name."""
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
def html(written) -> Page:
    return Page((written / "report.html").read_text(encoding="utf-8"))


def test_every_section_is_there(html):
    assert set(html.ids) >= SECTIONS
    assert len(html.ids) == len(set(html.ids))
    assert {"figure-convergence", "figure-cumulative-cost", "figure-path-loss", "figure-residual-over-distance",
            "figure-residual-by-group"} <= set(html.ids)  # fmt: skip


def test_the_map_comes_before_the_convergence(written):
    html = (written / "report.html").read_text(encoding="utf-8")
    assert html.index('id="links-map"') < html.index('id="values"') < html.index('id="figures"')
    assert re.search(r"page of \d{4}-\d\d-\d\d<", html)


def test_percent_signs_follow_a_space_and_names_break_after_the_material(written, result):
    html = (written / "report.html").read_text(encoding="utf-8")
    text = re.sub(r"<(script|style|svg|pre).*?</\1>", "", html, flags=re.DOTALL)
    assert re.search(r"\d %", text)
    assert not re.search(r"\d%", re.sub(r"<[^>]*>", "", text))
    material, _, constant = next(iter(result.parameters)).rpartition(".")
    assert f"{material}.<wbr>{constant}" in html


def test_numbers_on_logarithmic_axes_have_no_exponents():
    assert [plain_number(value) for value in (1e-5, 0.02, 1.0, 50.0, 2e6)] == [
        "0.00001",
        "0.02",
        "1",
        "50",
        "2,000,000",
    ]


def test_the_headline_compares_the_prediction_model_with_its_rivals(result):
    block = np.arange(len(result.links)) % 2
    errors = {
        name: np.full(len(block), size) for name, size in ((Model.INITIAL, 2.5), (Model.CALIBRATED, 3.5))
    }
    held_out = HeldOutErrors(
        ("1", "2"), block, errors, np.zeros((len(block), 3)), result.links.measured_db.to_numpy()
    )
    judged = changed(
        result, held_out=held_out, holdout_rmse_db=3.5, nuisance_only_holdout_rmse_db=2.5,
        log_distance_holdout_rmse_db=4.5,
    )  # fmt: skip
    model = replace(judged.prediction.model, name=Model.INITIAL, residual_db=2.5)
    judged = replace(judged, prediction=replace(judged.prediction, model=model))
    (heading, value, comparison), links, *_ = reports._tiles(judged)
    assert (heading, value) == ("RMSE, held-out links", "2.50 dB")
    assert comparison == (
        "initial materials", "initial materials, offset only: 2.50 dB", "log-distance model: 4.50 dB",
    )  # fmt: skip
    # No "0 of them held out" next to a held-out RMSE.
    assert links[2] == (f"{len(block)} of them held out in turn, in 2 blocks",)
    assert dict(row[:2] for row in tables.links(judged).rows)["held out"] == str(len(block))
    in_turn = replace(judged, links=judged.links.assign(held_out=False))
    assert {row[-2] for row in reports._worst(in_turn, survey(in_turn)).rows} == {"in turn"}


def test_links_are_shown_in_the_quantity_that_was_measured(result):
    content = result.study.content()
    content["links"]["quantity"], content["offset"] = "rsrp", {"per": "half"}
    study = cb.Study.from_content(content, result.study.path)
    links = result.links.assign(measured_rsrp_dbm=-result.links.measured_db)
    received = replace(result, study=study, links=links)
    power, residuals = in_measured_quantity(received, "predicted"), survey(received).residual_db
    reached = links.has_path.to_numpy(bool)
    assert power[reached] == pytest.approx(-links.predicted_db[reached].to_numpy())
    assert residuals[reached] == pytest.approx((power + links.measured_db.to_numpy())[reached])
    headings = [column.heading for column in reports._worst(received, survey(received)).columns]
    assert "measured [dBm]" in headings
    leverage = [every.diagnostics["leverage"].residual_db.to_numpy() for every in (received, result)]
    assert leverage[0] == pytest.approx(-leverage[1])
    assert path_loss_by_receiver({"auto": received}).axes[0].get_ylabel() == "RSRP [dBm]"


def test_nothing_is_loaded_from_anywhere(html, written):
    inner = {f"#{name}" for name in html.ids}
    for reference in html.references:
        assert reference in inner or reference.startswith("data:"), reference
    assert not {"iframe", "object", "embed", "form", "base", "img"} & set(html.tags)
    text = (written / "report.html").read_text(encoding="utf-8")
    assert "://" not in text
    assert "default-src 'none'" in text
    assert not re.search(r"url\((?!#|&#34;#|data:)", "".join(html.scripts[:1]))


def test_hostile_names_are_text(html, result):
    assert HOSTILE in html.words
    assert HOSTILE in html.data["groups"]
    # The page's own three: style, data and viewer.
    assert len(html.scripts) == 3
    assert "\u2028" not in html.scripts[1]


def test_embedded_data_equal_the_result(html, result):
    links = html.data["links"]
    table = result.links
    assert links["row"] == table.row.tolist()
    assert links["measured"] == pytest.approx(table.measured_db.tolist(), abs=0.0051)
    predicted = [np.inf if value is None else value for value in links["predicted"]]
    assert predicted == pytest.approx(table.predicted_db.tolist(), abs=0.0051)
    assert sum(links["held"]) == table.held_out.sum() > 0
    assert links["held_out"] == ["yes" if held else "no" for held in table.held_out]
    words = " ".join(html.words.split())
    assert f"RMSE {result.holdout_rmse_db:.2f} dB" in words
    for name, value in result.parameters.items():
        assert name in words
        assert f"{value:.4g}" in words


def test_drawn_paths_have_the_traced_length(result):
    """The lengths between the drawn points add up to each path's delay."""
    paths = result.paths
    for path in range(paths.num_paths):
        link = paths.link[path]
        inner = paths.vertex[paths.first[path] : paths.first[path + 1]].astype(float)
        points = np.concatenate([paths.tx_position[link, None], inner, paths.rx_position[link, None]])
        length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        assert length == pytest.approx(paths.delay[path] * 299_792_458, rel=1e-5)


def test_the_strongest_paths_have_the_power_of_the_link(result):
    shown = strongest(result.paths, result)
    assert (np.diff(shown.paths.link) >= 0).all()
    for link in np.unique(shown.paths.link):
        gains = shown.gain_db[shown.paths.link == link]
        assert (np.diff(gains) <= 0).all()
        assert len(gains) <= PER_LINK
    # No link of this scene has more paths than are shown, so their power is that of the link.
    assert shown.paths.num_paths == shown.traced
    power = np.bincount(shown.paths.link, 10 ** (shown.gain_db / 10), len(result.links))
    reached = power > 0
    offset = np.array([result.nuisance.offsets_db[name] for name in result.links["group"]])
    assert -10 * np.log10(power[reached]) + offset[reached] == pytest.approx(
        result.links.after_db[reached], abs=1e-3
    )
    assert shown.links_by_material["concrete"] > 0
    assert shown.links_by_material["glass"] == 0


def test_only_the_strongest_of_many_paths_are_shown(result):
    many = synthetic.program([(Kind.SPECULAR,)] * 600, links=2)
    shown = strongest(many, changed(result, materials=many.materials))
    assert np.bincount(shown.paths.link).tolist() == [PER_LINK, PER_LINK]
    gain = 20 * np.log10(np.abs(cb.path_gains(many)))
    for link in range(2):
        best = np.sort(gain[many.link == link])[::-1][:PER_LINK]
        assert shown.gain_db[shown.paths.link == link] == pytest.approx(best)
    assert INTERACTIONS > 24


def test_positions_missing_in_the_result_come_from_the_study(written, result, tmp_path):
    old = Result.load(written)
    old = changed(old, links=old.links.drop(columns=["tx_x", "group"]))
    links = survey(old)
    assert links.rx == pytest.approx(survey(result).rx)
    assert links.group.tolist() == survey(result).group.tolist()


def test_inputs_that_cannot_be_read_any_more_are_listed(written, result, tmp_path):
    gone = Result.load(written)
    content = gone.study.content()
    content["links"]["file"], content["scene"]["file"] = "absent.csv", "absent.xml"
    gone = replace(
        gone, study=cb.Study.from_content(content, "study.toml"), links=gone.links[["row", "measured_db", "before_db",
        "after_db", "log_distance_db", "has_path", "held_out", "predicted_db", "scene_db"]],
    )  # fmt: skip
    cb.report(result, tmp_path / "report.html", figures=tmp_path / "figures")
    assert (tmp_path / "figures" / "residual-over-distance.png").exists()
    (tmp_path / "figures" / "own.png").write_bytes(b"")
    cb.report(gone, tmp_path / "report.html", figures=tmp_path / "figures")
    left = {path.name for path in (tmp_path / "figures").glob("*.png")}
    # A figure of the earlier report would be taken for one of this result.
    assert {"path-loss.png", "own.png"} <= left
    assert "residual-over-distance.png" not in left
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert set(page.ids) >= SECTIONS
    assert "absent.csv can no longer be read" in page.words
    assert page.data is None


def test_a_missing_folder_is_refused_before_the_report_is_made(result, tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        cb.report(result, tmp_path / "absent" / "report.html")


@pytest.mark.parametrize("name", ["report.pdf", "report", "report.html.gz"])
def test_a_report_of_another_format_is_refused(result, tmp_path, name):
    with pytest.raises(InputError, match=r"the report is an HTML page; choose a name that ends in \.html"):
        cb.report(result, tmp_path / name)
    assert not (tmp_path / name).exists()


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


def answer(result: Result, heading: str) -> str:
    """The sentences of the summary that answer a question."""
    sentences = summary(result)
    start = next(k for k, sentence in enumerate(sentences) if sentence.heading == heading)
    end = next((k for k in range(start + 1, len(sentences)) if sentences[k].heading), len(sentences))
    return " ".join(sentence.text for sentence in sentences[start:end])


HELP = "Did calibration help on held-out links?"


def judged(result: Result, rmse_db: float, baseline_db: float) -> Result:
    """The result with another judgement, of 60 held-out links in 15 clusters, with an error of 0.5 dB."""
    judgement = Judgement(60, rmse_db, "a log-distance model", baseline_db, 0.5, 15)
    return changed(result, judgement=judgement)


def test_the_summary_says_whether_calibration_helped(result):
    assert answer(judged(result, 2.0, 4.0), HELP).startswith(
        "Calibration helped on held-out links: RMSE 2.00 dB"
    )
    assert "did not help" in answer(judged(result, 4.0, 3.9), HELP)
    assert "did not clearly help" in answer(judged(result, 3.9, 4.0), HELP)
    assert "2.00 dB less than a log-distance model, the best baseline" in answer(
        judged(result, 2.0, 4.0), HELP
    )
    one = changed(result, judgement=Judgement(1, 2.0, "a log-distance model", 4.0, None, 1))
    assert "on 1 held-out link, 2.00 dB less" in answer(one, HELP)
    unjudged = changed(result, judgement=None)
    assert "Set [holdout] blocks = 4, or run calibray validate" in answer(unjudged, HELP)
    # Each block would take a calibration, which `calibray validate` refuses on this engine.
    expensive = changed(unjudged, study=result.study.replace(engine="retrace"))
    assert answer(expensive, HELP).endswith("new links best. Hold out links with [holdout] where.")


def test_the_summary_says_which_parameters_are_identified(result):
    verdicts = dict(zip(result.parameters, ("identified", "at bound", "not identifiable"), strict=True))
    known = changed(
        result, intervals={name: Interval(0.1, 2.0, 3.0, verdict) for name, verdict in verdicts.items()}
    )
    identified, _, unidentified = verdicts
    text = answer(known, "How certain are the values?")
    assert f"The links identify 1 of 3 parameters: {identified}" in text
    assert f"{unidentified} is not identifiable" in text
    assert "outside their intervals" not in text
    outside = changed(known, remarks=(Remark(RemarkKind.OUTSIDE_INTERVAL, {"names": [unidentified]}),))
    text = answer(outside, "How certain are the values?")
    assert f"Calibrated values outside their intervals: {unidentified}." in text
    # The values inside are many; none of them has to be more probable than the calibrated one.
    assert "nearly all probable values are inside the intervals" in text
    assert "more probable" not in text
    # One range, which does not contain the calibrated value, is ambiguous, too.
    one_range = changed(
        result, intervals={name: consistent(Interval(0.1, 2.0, 3.0, "identified"), 9.0) for name in verdicts}
    )
    assert "or the best fit is outside the interval" in answer(one_range, "How certain are the values?")
    material = unidentified.rpartition(".")[0]
    for count, words in (
        (0, "no path of any link interacts with this material"),
        (1, "1 of 12 links has paths that"),
    ):
        sentences = summary(known, {material: count})
        assert any(part.text.startswith(material) and words in part.text for part in sentences)
    # No path interacts with an antenna or a region.
    pose = Interval(5.0, -9.0, 9.0, Verdict.NOT_IDENTIFIABLE)
    turned = changed(result, intervals={"tx:S1.azimuth": pose, "region:trees.specific_attenuation": pose})
    assert not any("interact" in part.text for counts in (None, {}) for part in summary(turned, counts))
    without_intervals = changed(result, intervals={})
    assert "provides no derivatives" in answer(without_intervals, "How certain are the values?")


def test_bars_show_values_and_intervals_at_their_positions(result):
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
    assert entry.positions == pytest.approx({"before": 0.5, "after": 0.75})
    assert entry.pieces[0] == pytest.approx((0.25, 1.0))


# Map and scene


def test_the_map_shows_footprints_at_their_positions(tmp_path, result):
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
    expected = [
        {tuple(point) for point in shown.project(np.array(corner)).round(1).tolist()} for corner in corners
    ]
    assert sorted(map(sorted, outlines)) == sorted(map(sorted, expected))
    walls = [
        {tuple(map(float, point.split(","))) for point in wall.split("L")}
        for wall in shown.walls.removeprefix("M").split("M")
    ]
    assert len(walls) == 8
    assert set.union(*walls) == set.union(*expected)


def test_faces_that_share_edges_have_one_outline():
    assert [sorted(loop) for loop in _loops(np.array([[0, 1, 2], [0, 2, 3]]))] == [[0, 1, 2, 3]]
    assert sorted(map(len, _loops(np.array([[0, 1, 2], [3, 4, 5]])))) == [3, 3]


def test_objects_that_cannot_be_read_are_listed(tmp_path):
    file = write_scene(
        tmp_path, {"house": block((0, 0, 0), (20, 10, 8)), "broken": block((0, 0, 0), (1, 1, 1))}
    )
    scene = read_scene(file, 3.5e9)
    (tmp_path / "meshes" / "broken.ply").write_text("ply\nnonsense")
    triangles = read_triangles(scene)
    assert triangles.left_out == ("broken",)
    assert len(triangles.face) == 12


def test_colours_distinguish_positive_and_negative_residuals():
    colors = ramp(np.array([-9.0, 0.0, 9.0, np.nan]), 5.0)
    assert colors == ["#1f5fa8", "#a9b4bd", "#b34a00", "none"]


def test_the_grid_rounds_positions_to_its_step():
    points = np.random.default_rng(1).uniform(-800, 1200, (500, 3))
    grid = Grid.over(points)
    assert grid.low + grid.step * grid.steps(points) == pytest.approx(points, abs=0.51 * grid.step)
    assert grid.step < 0.04


def test_links_contain_received_power_with_its_sign(tmp_path):
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


def test_a_failing_report_does_not_lose_the_result(written, monkeypatch, tmp_path):
    from typer.testing import CliRunner

    from calibray.cli.app import app

    study = Result.load(written).study
    (tmp_path / "links.csv").write_text((study.path.parent / "links.csv").read_text())
    monkeypatch.setattr(reports, "page", None)

    def calibrate(*_, out, **__):
        result = Result.load(written)
        result.save(out)
        return result

    monkeypatch.setattr("calibray.calibration.calibrate.calibrate", calibrate)
    file = tmp_path / "study.toml"
    file.write_text(
        'version = 1\nscene = { file = "sionna:simple_street_canyon", frequency = 3.5e9 }\n'
        'links = { file = "links.csv", tx = ["tx_x", "tx_y", "tx_z"], rx = ["rx_x", "rx_y", "rx_z"], '
        'value = "path_loss_db" }\nparameters = { "wood.thickness" = { bounds = [0.1, 0.2] } }\n'
    )
    done = CliRunner().invoke(app, ["run", str(file), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert "Warning: the report was not written" in done.stderr
    assert "calibray report" in done.stderr
    assert Result.load(tmp_path / "out").parameters == Result.load(written).parameters
    assert not (tmp_path / "out" / "report.html").exists()


def test_groups_that_are_carriers_are_written_with_a_unit(result):
    content = result.study.content()
    content["links"]["frequency"], content["offset"] = "carrier", {"per": "carrier"}
    carriers = replace(result, study=cb.Study.from_content(content, result.study.path))
    assert [group_text(carriers, label) for label in ("28000000000", "700e6", "A")] == [
        "28 GHz", "700 MHz", "A",
    ]  # fmt: skip
    assert group_text(result, "28000000000") == "28000000000"
    offsets = {"offset": {"28000000000": 1.0, "3500000000": 2.0}}
    rows = tables.nuisances(replace(carriers, nuisance=replace(carriers.nuisance, coefficients=offsets))).rows
    assert rows[:2] == (("28 GHz", "+1.00"), ("3.5 GHz", "+2.00"))
    shared = np.linspace(0.0, 1.0, 50)
    draws = {"offset[28000000000]": shared, "offset[3500000000]": shared}
    certain = replace(carriers.uncertainty, draws=draws)
    shown = replace(carriers, uncertainty=certain, nuisance=replace(carriers.nuisance, coefficients=offsets))
    assert dict(diagnostics_table(shown).rows)["trade-offs"] == "offset[28 GHz] and offset[3.5 GHz] (+1.00)"
    content["links"]["frequency"], content["offset"] = "Carrier (MHz)", {"per": "Carrier (MHz)"}
    megahertz = replace(result, study=cb.Study.from_content(content, result.study.path))
    assert group_text(megahertz, "3500") == "3.5 GHz"


def test_a_legend_is_not_over_the_errors_of_blocks(result):
    block = np.arange(len(result.links)) % 2
    errors = dict.fromkeys((Model.INITIAL, Model.CALIBRATED), np.full(len(block), 2.5))
    measured = result.links.measured_db.to_numpy()
    figure = held_out_blocks(Validation(("1", "2"), block, errors, np.zeros((len(block), 3)), measured))
    figure.draw_without_rendering()
    (axes,) = figure.axes
    assert axes.get_legend().get_window_extent().y0 >= axes.bbox.y1


def test_signed_numbers_that_round_to_zero_are_not_negative(result):
    offsets = {"offset": {"north": -0.004, "south": -0.006}}
    rows = tables.nuisances(replace(result, nuisance=replace(result.nuisance, coefficients=offsets))).rows
    assert [row[1] for row in rows] == ["+0.00", "-0.01"]
