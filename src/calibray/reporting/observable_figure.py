"""Measured and modelled values of further observables, link by link."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from calibray.result.record import Record
from calibray.support.figure_style import BLUE, FAINT, INK, ORANGE, dress, styled
from calibray.support.messages import shortened

MOST: Final = 6
"""Observables that are drawn, the first ones of the study."""


@styled()
def measured_over_modelled(result: Record) -> Figure | None:
    """Draw measured over modelled values of the observables, with biases of devices taken off.

    Args:
        result: The calibration.

    Returns:
        The figure; None without further observables.
    """
    fits = dict(list(result.fit.observables.items())[:MOST])
    if not fits:
        return None
    columns = min(len(fits), 3)
    rows = -(-len(fits) // columns)
    figure = Figure(figsize=(3.2 * columns + 0.4, 3.0 * rows + 0.3), dpi=150, layout="constrained")
    held_out = result.links["held_out"].to_numpy(bool)
    for number, (name, fit) in enumerate(fits.items(), start=1):
        axes = figure.add_subplot(rows, columns, number)
        dress(axes, f"modelled [{fit.unit}]", f"measured [{fit.unit}]")
        measured, modelled = (
            result.links[f"{name}_{when}_{fit.unit}"].to_numpy(float) for when in ("measured", "after")
        )
        if (bias := f"{name}_bias_{fit.unit}") in result.links:
            measured = measured - result.links[bias].to_numpy(float)
        shown = np.isfinite(measured) & np.isfinite(modelled)
        for part, color, label in ((~held_out, BLUE, "calibration"), (held_out, ORANGE, "held out")):
            if (part & shown).any():
                axes.scatter(modelled[part & shown], measured[part & shown], s=10, c=color, lw=0, label=label)
        if shown.any():
            both = np.concatenate([measured[shown], modelled[shown]])
            ends = [both.min(), both.max()]
            axes.plot(ends, ends, color=INK, lw=0.8)
        axes.set_title(shortened(name, 28), fontsize=9)
        axes.legend(fontsize=7, labelcolor=FAINT, frameon=False)
    return figure
