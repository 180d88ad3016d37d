"""The window in a browser: start the server, walk through the steps by clicks and keys."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

CHROMIUM = os.environ.get("CALIBRAY_CHROMIUM") or shutil.which("chromium")
SIZES = {"desktop": (1280, 900), "phone": (390, 844)}


@contextmanager
def served(folder: Path, *, kill: bool = False):
    """The address of a window on a folder; with `kill`, the server gets no chance to clean up."""
    words = [sys.executable, "-m", "calibray", "open", str(folder), "--no-browser"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        try:
            yield server.stdout.readline().strip()
        finally:
            server.send_signal(signal.SIGKILL if kill else signal.SIGINT)
            server.wait(30)


@contextmanager
def launched():
    """A browser without a screen."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


def opened(browser, address: str, size: str = "desktop", scheme: str = "light"):
    """A page on the window; `page.noted` lists errors and requests that leave the server."""
    width, height = SIZES[size]
    context = browser.new_context(
        viewport={"width": width, "height": height}, color_scheme=scheme, reduced_motion="reduce"
    )
    page = context.new_page()
    page.noted = []
    origin = address.partition("?")[0]
    page.on("pageerror", lambda error: page.noted.append(f"error: {error}"))
    page.on(
        "request",
        lambda asked: asked.url.startswith((origin, "data:", "blob:")) or page.noted.append(asked.url),
    )
    page.goto(address)
    page.get_by_role("heading", name="Calibray").wait_for()
    return page


def step(page, name: str):
    """The section of a step."""
    return page.get_by_role("region", name=name, exact=True)


def add(page, name: str, files: list[Path]) -> None:
    """Choose files with the button of a step, and wait until the page says that they are added."""
    with page.expect_file_chooser() as chooser:
        step(page, name).get_by_role("button", name="Add").click()
    chooser.value.set_files(files)
    for file in files:
        page.get_by_text(f"Added: {file.name}").wait_for()


def press(page, name: str, button: str, seconds: float = 240) -> None:
    """Press a button that starts a command, and wait until the command is done."""
    before = command(page)
    start(page, name, button)
    finished(page, seconds, before)


def start(page, name: str, button: str) -> None:
    """Press a button that starts a command, and wait until the page shows the command."""
    before = command(page)
    for _ in range(3):
        step(page, name).get_by_role("button", name=button, exact=True).click()
        # A step that is shown again during a click loses the click, on a busy machine; a person would click again.
        for _ in range(100):
            if command(page) not in ("", before):
                return
            page.wait_for_timeout(100)
    raise AssertionError(f"{button}: started no command; the last one: {before}")


def command(page) -> str:
    """What the page says about the last command; empty if there was none."""
    activity = page.get_by_role("status", name="Last command")
    return activity.inner_text() if activity.count() else ""


def finished(page, seconds: float = 240, before: str = "") -> None:
    """Wait until the last command, another one than before, is done."""
    text = ""
    for _ in range(int(seconds * 10)):
        page.wait_for_timeout(100)
        text = command(page)
        if text not in ("", before) and not text.startswith("running"):
            assert text.startswith("done"), text
            return
    raise AssertionError(f"the command has not ended: {text}")


def choose(page, name: str, label: str, option: str) -> None:
    """Choose an option of a list."""
    step(page, name).get_by_label(label, exact=True).first.click()
    page.get_by_role("option", name=option, exact=True).click()
