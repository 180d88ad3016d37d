"""The report in a browser: nothing goes wrong, nothing is fetched, the scene is drawn, links can be chosen.

Needs Playwright and Debian's `chromium`, or the browser that CALIBRAY_CHROMIUM names.
"""

from __future__ import annotations

import os
import re
import shutil
from functools import cache

import pytest
from playwright.sync_api import sync_playwright

from calibray.reporting import figures
from calibray.reporting.page import page as write
from made_up_report import made_up

CHROMIUM = os.environ.get("CALIBRAY_CHROMIUM") or shutil.which("chromium")
pytestmark = pytest.mark.skipif(not CHROMIUM, reason="needs chromium; apt-get install chromium")

HOSTILE = "</script><script>window.hostile = 1</script><img src=x onerror='window.hostile = 1'>"
SIZES = {"desktop": (1280, 900), "phone": (390, 844)}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A report of 60 links; a material and a group have hostile names."""
    result, shown = made_up(60, 40, names=(HOSTILE, "ground"), groups=(HOSTILE, "south"))
    target = tmp_path_factory.mktemp("report") / "report.html"
    target.write_text(write(result, shown, figures.result_figures(result, shown.links)), encoding="utf-8")
    return target


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as started:
        chromium = started.chromium.launch(
            executable_path=CHROMIUM,
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def opened(browser, file):
    """Opens the report once for each size and scheme, and notes what goes wrong and what is asked for."""

    @cache
    def open_page(size="desktop", scheme="light", use=""):
        width, height = SIZES[size]
        page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
        noted = []
        page.on("console", lambda message: noted.append(f"console: {message.text}"))
        page.on("pageerror", lambda error: noted.append(f"error: {error}"))
        page.on("request", lambda asked: asked.url.startswith("data:") or noted.append(asked.url))
        page.goto(file.as_uri())
        drawn(page, 0)
        page.noted = noted
        return page

    return open_page


def drawn(page, before: int) -> int:
    """Wait until the scene was drawn more often than before; how often it was."""
    # The page's policy lets no text be run as a script, as waiting for an expression would.
    for _ in range(600):
        count = page.evaluate("Number(document.documentElement.dataset.drawn || 0)")
        if count > before:
            return count
        page.wait_for_timeout(50)
    pytest.fail("the scene was not drawn")


def colors(page) -> int:
    """Number of colours in the picture of the scene."""
    return page.evaluate(
        """() => { const canvas = document.getElementById("scene-canvas"), copy = document.createElement("canvas");
        [copy.width, copy.height] = [canvas.width, canvas.height];
        const context = copy.getContext("2d"); context.drawImage(canvas, 0, 0);
        return new Set(new Uint32Array(context.getImageData(0, 0, copy.width, copy.height).data.buffer)).size; }"""
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_it_opens_without_an_error_or_a_request(opened, file, size, scheme):
    page = opened(size, scheme)
    assert page.noted == [file.as_uri()]
    assert colors(page) > 100
    # Nothing is wider than the screen.
    assert page.evaluate("document.documentElement.scrollWidth") == SIZES[size][0]
    assert page.locator("section").count() == 9


def test_a_click_on_a_link_shows_its_paths(opened):
    page = opened()
    first = page.evaluate("document.documentElement.dataset.link")
    place = page.evaluate(
        """() => { const circle = [...document.querySelectorAll(".links circle")][5];
        const map = document.getElementById("map");
        map.scrollIntoView({ behavior: "instant", block: "center" }); const box = circle.getBoundingClientRect();
        return [box.x + box.width / 2, box.y + box.height / 2]; }"""
    )
    page.mouse.click(*place)
    chosen = page.evaluate("document.documentElement.dataset.link")
    assert chosen != first
    assert page.locator("#facts h3").inner_text().startswith(f"Row {chosen}, ")
    assert page.locator("#paths tr").count() == 12
    assert page.locator("#map-text").inner_text().startswith(f"Row {chosen}, ")


def test_a_click_into_the_scene_chooses_a_link(opened):
    page = opened()
    canvas = page.locator("#scene-canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    seen = set()
    for x in range(10, int(box["width"]), 30):
        page.mouse.click(box["x"] + x, box["y"] + box["height"] / 2)
        seen.add(page.evaluate("document.documentElement.dataset.link"))
        if len(seen) > 3:
            return
    pytest.fail(f"only {seen} were chosen")


def test_the_scene_turns_by_keyboard_and_by_hand(opened):
    page = opened(use="as it opens")
    canvas = page.locator("#scene-canvas")
    pictures = [page.evaluate("document.getElementById('scene-canvas').toDataURL()")]
    canvas.focus()
    for key in ("ArrowLeft", "ArrowUp", "+", "Home", "n"):
        before = page.evaluate("Number(document.documentElement.dataset.drawn)")
        page.keyboard.press(key)
        drawn(page, before)
        pictures.append(page.evaluate("document.getElementById('scene-canvas').toDataURL()"))
    assert len(set(pictures)) == 5
    assert pictures[4] == pictures[0]
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    before = page.evaluate("Number(document.documentElement.dataset.drawn)")
    page.mouse.move(box["x"] + 200, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 260, box["y"] + 140)
    page.mouse.up()
    drawn(page, before)
    assert page.evaluate("document.getElementById('scene-canvas').toDataURL()") not in pictures


def test_the_list_chooses_by_keyboard_and_sorts(opened):
    page = opened()
    links = page.locator("#links")
    links.focus()
    page.keyboard.press("Home")
    assert page.evaluate("document.documentElement.dataset.link") == "2"
    page.keyboard.press("ArrowDown")
    assert page.evaluate("document.documentElement.dataset.link") == "3"
    page.locator("#order").select_option("residual")
    left = [text for text in links.locator("option").all_inner_texts() if "no path" not in text]
    sizes = [float(re.search(r"[+−]([0-9.]+) dB", text)[1]) for text in left]
    assert sizes == sorted(sizes, reverse=True)


def test_values_and_verdicts_fit_a_phone(opened):
    page = opened("phone")
    ends = page.evaluate(
        "[...document.querySelectorAll('.values td')].map((cell) => cell.getBoundingClientRect().right)"
    )
    assert ends
    assert max(ends) <= SIZES["phone"][0]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_outlines_and_walls_are_drawn_on_the_map(opened, scheme):
    page = opened(scheme=scheme)
    lengths = page.evaluate(
        "[...document.querySelectorAll('#map .buildings, #map .walls')].map((path) => path.getTotalLength())"
    )
    assert min(lengths) > 1000
    colors = page.evaluate(
        "[getComputedStyle(document.getElementById('map')).backgroundColor, "
        "getComputedStyle(document.querySelector('#map .buildings')).fill]"
    )
    assert colors[0] != colors[1]


def test_a_link_without_a_path_says_so(opened):
    page = opened()
    page.locator("#links").select_option("0")
    assert "no path" in page.locator("#facts").inner_text()
    assert not page.locator("#paths-table").is_visible()


def test_hostile_names_do_nothing_but_stand_there(opened):
    page = opened()
    page.locator("#links").select_option("1")
    assert page.evaluate("window.hostile") is None
    assert HOSTILE in page.locator("#links").inner_text()
    assert HOSTILE in page.locator("#facts").inner_text() + page.locator("#links").inner_text()
    assert page.locator("img").count() == 0


def test_it_can_be_read_without_a_3d_device(browser, file):
    context = browser.new_context()
    context.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page = context.new_page()
    page.goto(file.as_uri())
    page.locator("#links").select_option("3")
    assert page.locator("#scene-none").is_visible()
    assert page.locator("#paths tr").count() == 12
    context.close()


def test_it_prints(opened):
    page = opened("desktop", "dark", use="in print")
    page.emulate_media(media="print")
    assert not page.locator("nav").is_visible()
    assert page.evaluate("getComputedStyle(document.body).color") == "rgb(0, 0, 0)"
    assert len(page.pdf()) > 20_000
