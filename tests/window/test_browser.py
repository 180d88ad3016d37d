"""The window in a browser: from an empty folder to a drafted study by clicks, by keyboard, at all sizes.

Needs Playwright and Debian's `chromium`, or the browser that CALIBRAY_CHROMIUM names. `benchmarks/window_walk.py` walks
on, through a calibration.
"""

from __future__ import annotations

import io
import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from axe_playwright_python.sync_playwright import Axe

from calibray.scenes import read_scene, read_triangles
from calibray.window.desk import LARGEST, RADIUS, StudyFolder, solid
from window_server import (
    CHROMIUM,
    SIZES,
    add,
    command,
    finished,
    launched,
    opened,
    press,
    served,
    start,
    step,
)

pytestmark = pytest.mark.skipif(not CHROMIUM, reason="needs chromium; apt-get install chromium")

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "bring_your_own" / "flat"
GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "result" / "result.json"
RULES = {"runOnly": {"type": "tag", "values": ["wcag2a", "wcag2aa", "wcag21aa"]}, "iframes": False}
HOSTILE = "<img src=x onerror='window.hostile=1'>"


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """A folder that clicks have brought to a drafted study, and its page; the server is killed during a command."""
    folder = tmp_path_factory.mktemp("study")
    with launched() as browser:
        with served(folder, kill=True) as address:
            page = opened(browser, address)
            add(page, "Map or plan", [EXAMPLES / "plan.csv"])
            start(page, "Map or plan", "Make the scene")
        # A result whose study has hostile names, with a report that tries to leave its frame.
        (folder / "result").mkdir()
        record = json.loads(GOLDEN.read_text())
        record["fit"]["parameters"][HOSTILE] = 1.0
        (folder / "result" / "result.json").write_text(json.dumps(record))
        script = "try { parent.hostile = 1 } catch {}; fetch('/').catch(() => 0)"
        report = f"<h1>Report</h1>{HOSTILE}<script>{script}</script>"
        (folder / "result" / "report.html").write_text(report)
        with served(folder) as address:
            page = opened(browser, address)
            finished(page)
            add(page, "Measurements", [EXAMPLES / "rss.csv"])
            page.get_by_label("Carrier frequency [Hz]").fill("2.44e9")
            # The step is shown again, and keeps what was entered.
            add(page, "Measurements", [EXAMPLES / "access_points.csv"])
            press(page, "Measurements", "Draft the study")
            page.locator("#plan[data-links='84']").wait_for()
            yield folder, page, browser, address


def test_the_clicks_wrote_what_the_command_line_writes(walked):
    folder, page, _, _ = walked
    study = tomllib.loads((folder / "study.toml").read_text())
    assert study["scene"] == {"file": "scene/scene.xml", "frequency": 2.44e9}
    assert study["links"]["wide"] == {"rss_ap1": "ap1", "rss_ap2": "ap2", "rss_ap3": "ap3"}
    # Commands of before the kill are still listed.
    runs = page.get_by_role("list", name="Commands").inner_text()
    assert "calibray scene plan plan.csv --out scene" in runs
    assert "calibray init scene/scene.xml rss.csv" in runs


def test_the_links_are_on_the_map_with_their_reasons_beside(walked):
    _, page, _, _ = walked
    assert page.locator("#plan").get_attribute("data-links") == "84"
    assert (
        step(page, "Measurements")
        .get_by_text("column names indicate metres; no height: 1.5 m", exact=True)
        .count()
        == 1
    )


def test_the_scene_is_shown_in_three_dimensions_by_its_materials(walked):
    folder, _, browser, address = walked
    # A page of its own: NiceGUI draws a scene again and again, also after its dialog was closed.
    page = opened(browser, address)
    page.get_by_role("button", name="Show in 3-D").click()
    dialog = page.get_by_role("dialog")
    materials = ["brick_wall", "plasterboard_wall", "floor", "ceiling"]
    dialog.get_by_role("checkbox", name="ceiling").wait_for()
    assert [box.inner_text() for box in dialog.get_by_role("checkbox").all()] == materials
    shown, area = solid(StudyFolder(folder), None), 0.0
    for number, name in enumerate(materials):
        answer = page.request.get(f"{address.partition('/?')[0]}/data/solid/{number}.stl")
        mesh = trimesh.load(io.BytesIO(answer.body()), file_type="stl")
        assert len(mesh.faces) == len(shown.meshes[name])
        area += mesh.area
    # The floor of the flat is 10 m by 7 m and it is 3 m high: its half diagonal becomes the radius.
    scale = 2 * RADIUS / np.linalg.norm([10.0, 7.0, 3.0])
    triangles = read_triangles(read_scene(str(folder / "scene" / "scene.xml"), 2.44e9))
    assert area == pytest.approx(np.linalg.norm(triangles.normal, axis=1).sum() * scale**2, rel=1e-5)
    assert np.linalg.norm(shown.meshes["floor"].max(axis=(0, 1))) <= RADIUS * 1.001
    # Before the backdrop of a dialog, axe takes the backdrop for the background of the texts.
    rules = {**RULES, "rules": {"color-contrast": {"enabled": False}}}
    assert not Axe().run(page, options=rules).response["violations"]
    page.keyboard.press("Escape")
    dialog.wait_for(state="hidden")
    assert page.noted == []
    page.context.close()


def test_nothing_is_asked_of_other_machines_and_hostile_names_are_text(walked):
    _, page, _, _ = walked
    assert page.noted == []
    assert page.get_by_role("rowheader", name=HOSTILE).count() == 1
    assert page.evaluate("window.hostile") is None
    assert page.frame_locator("iframe").locator("h1").inner_text() == "Report"
    assert page.get_by_text("Refused").count() == 0


def test_another_page_without_the_token_gets_nothing(walked):
    _, _, browser, address = walked
    page = browser.new_context().new_page()
    for path in ("/", "/data/plan.json", "/_nicegui/x", "/result/result/report.html", "/window/plan.js"):
        assert page.goto(address.partition("/?")[0] + path).status == 403
    page.context.close()


def test_only_the_page_and_the_map_of_a_result_are_served(walked):
    _, page, _, address = walked
    origin = address.partition("/?")[0]
    for path in ("/result/result/result.json", "/result/scene/scene.xml", "/window/none.js"):
        assert page.request.get(origin + path, max_redirects=0).status == 404
    # Any other path is the page itself.
    assert page.request.get(f"{origin}/study.toml").text().startswith("<!doctype html>")
    answer = page.request.get(f"{origin}/result/result/report.html")
    assert answer.headers["content-security-policy"].startswith("sandbox allow-scripts; default-src 'none'")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_contrast_names_and_roles_meet_wcag_aa(walked, size, scheme):
    _, page, _, _ = walked
    page.set_viewport_size(dict(zip(("width", "height"), SIZES[size], strict=True)))
    page.emulate_media(color_scheme=scheme)
    page.wait_for_timeout(800)
    assert page.evaluate("document.documentElement.scrollWidth") == SIZES[size][0]
    found = Axe().run(page, options=RULES).response["violations"]
    assert not found, "\n".join(
        f"{each['id']}: {node['html'][:300]}" for each in found for node in each["nodes"]
    )


def test_the_keyboard_alone_saves_bounds_and_chooses_a_place(walked):
    folder, page, _, _ = walked
    # A value of another step is saved too, as that step is shown again.
    scene = step(page, "Measurements").get_by_role("button", name="scene", exact=False).first
    scene.click()
    step(page, "Measurements").get_by_label("frequency", exact=True).fill("2.45e9")
    page.locator("#plan").focus()
    before = int(page.locator("#plan").get_attribute("data-drawn"))
    for key in ("ArrowLeft", "+", "Enter"):
        page.keyboard.press(key)
    page.get_by_text("Chosen place: x").wait_for()
    assert int(page.locator("#plan").get_attribute("data-drawn")) > before
    highest = step(page, "Parameters").get_by_label("Highest").first
    highest.focus()
    page.keyboard.press("Control+A")
    page.keyboard.type("9")
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.innerText").strip() == "Save parameters":
            break
    page.keyboard.press("Enter")
    page.get_by_text("Saved").first.wait_for()
    study = tomllib.loads((folder / "study.toml").read_text())
    assert next(iter(study["parameters"].values()))["bounds"] == [1.5, 9.0]
    assert study["scene"]["frequency"] == 2.45e9


def test_what_an_editor_changed_in_the_study_is_shown_and_not_undone(walked):
    folder, _, browser, address = walked
    page = opened(browser, address)
    page.locator("#plan[data-links='84']").wait_for()
    lowest = step(page, "Parameters").get_by_label("Lowest").first
    lowest.wait_for()
    text = (folder / "study.toml").read_text()
    before = f"{lowest.input_value()}, "
    (folder / "study.toml").write_text(text.replace(f"bounds = [{before}", "bounds = [1.25, ", 1))
    for _ in range(100):
        if lowest.input_value() == "1.25":
            break
        page.wait_for_timeout(100)
    # The fixture's tab watches the study as well; a click is lost if another tab redraws the button.
    save = step(page, "Parameters").get_by_role("button", name="Save parameters")
    save.evaluate("button => { button.dataset.drawn = 'once' }")
    page.wait_for_timeout(1500)
    assert save.get_attribute("data-drawn") == "once"
    save.click()
    page.get_by_text("Saved").first.wait_for()
    study = tomllib.loads((folder / "study.toml").read_text())
    assert next(iter(study["parameters"].values()))["bounds"][0] == 1.25
    (folder / "study.toml").write_text(text)
    page.context.close()


def test_a_column_of_heights_is_refused_for_a_plan(walked):
    _, _, browser, address = walked
    page = opened(browser, address)
    page.locator("#plan[data-links='84']").wait_for()
    before = command(page)
    step(page, "Map or plan").get_by_text("Settings of the scene").click()
    height = step(page, "Map or plan").get_by_label("Height: a column, or metres")
    height.fill("storeys")
    step(page, "Map or plan").get_by_role("button", name="Make the scene").click()
    page.get_by_text("Height storeys: must be a number [m]").wait_for()
    assert command(page) == before
    height.fill("")
    page.wait_for_timeout(300)
    page.context.close()


def test_a_hostile_upload_is_refused(walked, tmp_path):
    folder, page, _, _ = walked
    bad = tmp_path / "<b>x.csv"
    shutil.copy(EXAMPLES / "rss.csv", bad)
    step(page, "Map or plan").locator("input[type=file]").first.set_input_files(bad)
    page.get_by_text("use only letters, digits").wait_for()
    assert not (folder / "<b>x.csv").exists()


def test_a_file_beside_the_fields_for_files_does_not_replace_the_page(walked):
    _, page, _, _ = walked
    refused = """name => {
        const files = new DataTransfer();
        files.items.add(new File(["x"], "x.csv"));
        return !document.body.dispatchEvent(
            new DragEvent(name, { dataTransfer: files, bubbles: true, cancelable: true }));
    }"""
    assert page.evaluate(refused, "dragover")
    assert page.evaluate(refused, "drop")


def test_a_file_over_the_limit_is_refused_with_a_message(walked, tmp_path):
    folder, page, _, _ = walked
    with (tmp_path / "large.csv").open("wb") as sparse:
        sparse.truncate(LARGEST + 1)
    with page.expect_file_chooser() as chooser:
        step(page, "Measurements").get_by_role("button", name="Add").click()
    chooser.value.set_files(str(tmp_path / "large.csv"))
    page.get_by_text("Larger than 1 GiB").wait_for()
    assert not (folder / "large.csv").exists()


def test_the_area_and_the_place_stay_on_the_map_until_they_are_cleared(walked):
    _, _, browser, address = walked
    page = opened(browser, address)
    page.locator("#plan[data-links='84']").wait_for()
    page.get_by_role("button", name="Draw an area").click()
    box = page.locator("#plan").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 250, box["y"] + 200, steps=3)
    page.mouse.up()
    predict = step(page, "Predict and use")
    predict.get_by_text(re.compile(r"Area: x [\d.]+ to [\d.]+ m, y [\d.]+ to [\d.]+ m")).wait_for()
    area = page.locator("#plan").get_attribute("data-area")
    predict.get_by_label("x [m]").fill("2.5")
    predict.get_by_label("y [m]").fill("3.5")
    page.locator("#plan[data-place='2.5,3.5']").wait_for()
    page.reload()
    page.locator("#plan[data-place='2.5,3.5'][data-links='84']").wait_for()
    west = float(page.locator("#plan").get_attribute("data-area").split(",")[0])
    assert west == pytest.approx(float(area.split(",")[0]), abs=0.06)
    page.get_by_role("button", name="Clear the area").click()
    predict.get_by_text("Area: the whole scene").wait_for()
    page.locator("#plan[data-area='']").wait_for()
    page.context.close()


def test_two_fingers_zoom_the_map(walked):
    _, _, browser, address = walked
    page = opened(browser, address)
    page.locator("#plan[data-links='84']").wait_for()
    box = page.locator("#plan").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before = float(page.locator("#plan").get_attribute("data-zoom"))
    predict = step(page, "Predict and use")
    predict.get_by_label("x [m]").fill("2.5")
    predict.get_by_label("y [m]").fill("3.5")
    page.locator("#plan[data-place='2.5,3.5']").wait_for()
    fingers = page.context.new_cdp_session(page)
    for kind, apart in (("touchStart", 40), ("touchMove", 60), ("touchMove", 120), ("touchEnd", None)):
        points = (
            []
            if apart is None
            else [
                {"x": middle[0] + side * apart / 2, "y": middle[1], "id": id_}
                for id_, side in enumerate((-1, 1))
            ]
        )
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    page.wait_for_function(
        "before => Math.abs(document.getElementById('plan').dataset.zoom / before - 3) < 0.01", arg=before
    )
    assert page.locator("#plan").get_attribute("data-place") == "2.5,3.5"
    page.context.close()


def test_an_empty_field_is_named_and_starts_nothing(walked):
    folder, _, browser, address = walked
    page = opened(browser, address)
    page.locator("#plan[data-links='84']").wait_for()
    page.wait_for_timeout(600)
    before, text = command(page), (folder / "study.toml").read_text()
    step(page, "Predict and use").get_by_label("Width of a cell [m]").fill("")
    step(page, "Predict and use").get_by_role("button", name="Map the area").click()
    page.get_by_text("Width of a cell [m]: is empty; give a number").wait_for()
    step(page, "Parameters").get_by_label("Lowest").first.fill("")
    step(page, "Parameters").get_by_role("button", name="Save parameters").click()
    page.get_by_text("brick_wall.relative_permittivity: Lowest: is empty; give a number").wait_for()
    assert command(page) == before
    assert (folder / "study.toml").read_text() == text
    # The messages are over the buttons.
    while page.get_by_role("button", name="Close").count():
        page.get_by_role("button", name="Close").first.click()
        page.wait_for_timeout(300)
    # A map needs the group of the offset of its transmitter; the result has no links, so the command fails.
    step(page, "Predict and use").get_by_label("Width of a cell [m]").fill("2")
    start(page, "Predict and use", "Map the area")
    assert "calibray map result --tx 0.6 0.7 2.2 --height 1.5 --cell 2.0 --column=ap=ap1" in command(page)
    page.get_by_text("failed: calibray map result").first.wait_for(timeout=120_000)
    page.context.close()


def test_stop_is_the_same_button_while_the_progress_changes(walked):
    folder, page, browser, address = walked
    study = folder / "study.toml"
    drafted = study.read_text()
    # With so many rays, the command takes minutes on any machine.
    study.write_text(drafted.replace('samples = "auto"', "samples = 20_000_000"))
    assert study.read_text() != drafted
    # A second tab, opened later, that shows the same command.
    other = opened(browser, address)
    other.locator("#plan[data-links='84']").wait_for()
    start(page, "Run", "Check the rays")
    page.get_by_role("button", name="Stop").focus()
    other.get_by_role("button", name="Stop").wait_for()
    stages = page.get_by_role("status", name="Last command").locator(".stage")
    page.wait_for_function("""() => document.querySelector(".activity .stage").innerText.includes("· ")""")
    assert page.evaluate("document.activeElement.innerText").strip() == "Stop"
    assert stages.count() == 1
    page.keyboard.press("Enter")
    page.get_by_text("stopped: calibray trace study.toml --check").first.wait_for(timeout=120_000)
    study.write_text(drafted)
    other.context.close()


def test_the_chosen_result_is_exported_and_nothing_entered_is_lost(walked):
    folder, _, browser, address = walked
    shutil.copytree(folder / "result", folder / "result-2")
    page = opened(browser, address)
    page.locator("#plan[data-links='84']").wait_for()
    page.wait_for_timeout(600)
    predict = step(page, "Predict and use")
    assert predict.get_by_label("Result").input_value() == "result-2"
    predict.get_by_label("Result").click()
    page.get_by_role("option", name="result", exact=True).click()
    lowest = step(page, "Parameters").get_by_label("Lowest").first
    lowest.fill("1.7")
    start(page, "Predict and use", "Export")
    page.get_by_text(re.compile(r"calibray export result --out exported-result")).first.wait_for()
    page.wait_for_timeout(600)
    assert predict.get_by_label("Result").input_value() == "result"
    assert lowest.input_value() == "1.7"
    page.context.close()
