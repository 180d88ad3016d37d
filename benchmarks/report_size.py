"""Size of the report of a large study, and the time that a browser takes to open it, compared with a small report.

    python benchmarks/report_size.py [--links 10000] [--buildings 5000] [--keep FILE]

Links, buildings and paths are synthetic. The browser is Debian's `chromium`, controlled by Playwright; without it, only
the size is measured. A browser without a graphics card renders in software, which is the slow case.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from calibray.reporting import figures
from calibray.reporting.page import page
from made_up_report import made_up

if TYPE_CHECKING:
    from playwright.sync_api import CDPSession

LIMIT_MB, LIMIT_S = 15.0, 5.0


def opened(file: Path) -> tuple[float, float]:
    """Time [s] from the request of a page until a link is selected and the scene is drawn.

    The first value is the wall time, which other work on the machine increases; the second is the processor time.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"),
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        view = browser.new_page(viewport={"width": 1280, "height": 900})
        counters = browser.new_browser_cdp_session()
        before = _processor(counters)
        start = time.perf_counter()
        view.goto(file.as_uri())
        while not view.evaluate("document.documentElement.dataset.drawn"):
            time.sleep(0.01)
        taken = time.perf_counter() - start
        spent = _processor(counters) - before
        browser.close()
    return taken, spent


def _processor(counters: CDPSession) -> float:
    """Processor time [s] of all processes of the browser so far, including the one that renders in software."""
    return sum(each["cpuTime"] for each in counters.send("SystemInfo.getProcessInfo")["processInfo"])


def main() -> None:
    """Make both reports, and print their size and time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--links", type=int, default=10_000)
    parser.add_argument("--buildings", type=int, default=5_000)
    parser.add_argument("--keep", type=Path, help="file for the large report")
    options = parser.parse_args()
    taken = []
    with tempfile.TemporaryDirectory() as folder:
        for links, buildings in ((100, 50), (options.links, options.buildings)):
            result, shown = made_up(links, buildings)
            start = time.perf_counter()
            text = page(result, shown, figures.result_figures(result, shown.links))
            made = time.perf_counter() - start
            file = Path(folder) / "report.html"
            file.write_text(text, encoding="utf-8")
            size = file.stat().st_size / 1e6
            print(f"{links:,} links, {buildings:,} buildings: {size:.2f} MB, written in {made:.1f} s")
            if options.keep and links == options.links:
                shutil.copy(file, options.keep)
            if shutil.which("chromium"):
                taken.append(opened(file))
                print(f"  opened in {taken[-1][0]:.2f} s, with {taken[-1][1]:.2f} s of processor time")
    print(f"size below {LIMIT_MB:g} MB: {size < LIMIT_MB}")
    if taken:
        print(
            f"opened in less than {LIMIT_S:g} s of processor time: {taken[-1][1] < LIMIT_S}; "
            f"{taken[-1][1] / taken[0][1]:.1f} times that of the small one"
        )


if __name__ == "__main__":
    main()
