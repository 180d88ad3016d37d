"""The common style of all figures: colours for colour-blind readers, no unnecessary lines, and units on the axes.

Most line colours are from the palette of Okabe and Ito (2008). A figure on an HTML page takes the colours of its axes
and text from the page, so that the figure is readable on both light and dark backgrounds.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any, Final, Literal

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from calibray.support.output_files import replacing

INK: Final = "#222222"
FAINT: Final = "#8a8a8a"
LINE: Final = "#e6e6e6"
PAPER: Final = "#ffffff"
BLUE: Final = "#0072b2"
ORANGE: Final = "#d55e00"
GREEN: Final = "#009e73"
PALETTE: Final = ("#cc79a7", "#e69f00", "#56b4e9", "#8c5a3c", "#882255", "#6f7f2e", "#5c6bc0", "#777777")
"""Further line colours, used once the named colours are exhausted."""

COLORS: Final = {"gwo": GREEN, "sgwo-im": BLUE, "space-mapping": FAINT, "auto": ORANGE}
"""Colour of each optimizer: the methods of the paper, and Calibray's own methods."""

_VARIABLES: Final = {INK: "--ink", FAINT: "--faint", LINE: "--line", PAPER: "--paper", BLUE: "--accent"}
_SETTINGS: Final[dict[Any, Any]] = {
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": INK,
    # Names come from files, so a dollar sign in a name must not start a formula.
    "text.parse_math": False,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "svg.hashsalt": "calibray",
}


@contextmanager
def styled(text_as: str = "path") -> Iterator[None]:
    """Apply the style within the context; SVG text is stored as outlines ("path") or as characters ("none")."""
    with rc_context({**_SETTINGS, "svg.fonttype": text_as}):
        yield


def plain_figure(x: str, y: str, width: float = 6.4, height: float = 4.2) -> tuple[Figure, Axes]:
    """Make an empty single-panel figure in the common style, with axis labels that state units; sizes are in inches."""
    with styled():
        figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
        axes = figure.add_subplot()
    dress(axes, x, y)
    return figure, axes


def residual_figure(x: str) -> tuple[Figure, Axes]:
    """Make an empty figure for the path-loss residuals of links, with a line at zero."""
    figure, axes = plain_figure(x, "Predicted − measured [dB]")
    axes.axhline(0, color=INK, lw=0.8)
    return figure, axes


def dress(axes: Axes, x: str, y: str) -> None:
    """Label the axes, and remove elements that carry no information."""
    axes.set(xlabel=x, ylabel=y)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=LINE)
    axes.set_axisbelow(True)


def plain_number(value: float) -> str:
    """Format a number without an exponent, for example as 1,000,000 or 0.00001."""
    return f"{value:,.12f}".rstrip("0").rstrip(".")


def logarithmic(axes: Axes, direction: Literal["x", "y"]) -> None:
    """Make an axis logarithmic, with numbers written out, because text in these figures cannot contain formulas."""
    axes.set(**{f"{direction}scale": "log"})
    axis = axes.xaxis if direction == "x" else axes.yaxis
    low, high = sorted(axis.get_view_interval())
    if low > 0 and high < 100 * low:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    axis.set_minor_formatter(NullFormatter())


def write(figure: Figure, path: Path) -> Path:
    """Write a figure as SVG if the file name ends in .svg, otherwise as PNG; return the file."""
    with styled(), replacing(path) as partial:
        if path.suffix == ".svg":
            FigureCanvasSVG(figure).print_svg(partial, metadata={"Date": None})
        else:
            FigureCanvasAgg(figure).print_png(partial)
    return path


def inline(figure: Figure, name: str) -> str:
    """Make an SVG element from a figure; the element takes its colours and font from the surrounding page.

    All ids in the element begin with `name`, and the element has no external references.
    """
    written = StringIO()
    figure.patch.set_visible(False)
    for axes in figure.axes:
        axes.patch.set_visible(False)
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with styled("none"):
        FigureCanvasSVG(figure).print_svg(written, metadata=nothing)
    text = written.getvalue()
    text = text[text.index("<svg") :]
    # A style sheet in the SVG would apply to the whole page, which already has the same rules. HTML needs no
    # namespaces.
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", text)
    for side in ("width", "height"):
        text = re.sub(rf'(<svg[^>]*?)\s{side}="[^"]*"', r"\1", text, count=1)
    for color, variable in _VARIABLES.items():
        text = text.replace(color, f"var({variable})")
    return text
