"""What the paper's experiment writes: its figures, its record, and a folder for each method."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Final

from calibray.comparison.experiment import METHODS
from calibray.reporting import figures
from calibray.support import figure_style as style
from calibray.support.output_files import write_text

if TYPE_CHECKING:
    from calibray.comparison.experiment import Demo

FIGURES: Final = ("cumulative-cost.png", "convergence.png", "path-loss.png")


def write(demo: Demo, out: Path) -> None:
    """Write the experiment.

    Args:
        demo: The experiment.
        out: Folder to write into; made if absent.
    """
    out.mkdir(parents=True, exist_ok=True)
    black_box = {method: demo.results[method] for method in METHODS}
    drawn = (
        figures.cumulative_cost(black_box),
        figures.convergence(black_box, demo.optimum_db),
        figures.path_loss_by_receiver(demo.results),
    )
    for name, figure in zip(FIGURES, drawn, strict=True):
        style.write(figure, out / name)
    for method, result in demo.results.items():
        result.save(out / method)
    write_text(out / "result.json", json.dumps(demo.content(), indent=2) + "\n")
