"""The cost of predictions: how many links are traced, and about how long that takes."""

from __future__ import annotations

import logging
from typing import Final

from calibray.result.record import Record
from calibray.support.messages import duration
from calibray.tracing.trace_plan import LANES_PER_SECOND

LOG: Final = logging.getLogger(__name__)
"""Costs are logged before the work; the command line prints them."""


def announce(result: Record, links: int, what: str = "links") -> None:
    """Log how many links are traced, and about how long that takes.

    Args:
        result: The calibration.
        links: Number of links.
        what: What they are.
    """
    if result.prediction.model.parameters is None:
        LOG.info("%s %s, predicted without a trace: the log-distance model uses no scene", f"{links:,}", what)
        return
    calibrated, seconds = len(result.links), _seconds(result, links)
    time = f"up to about {duration(seconds)}" if seconds >= 2 else "less than 2 seconds"
    LOG.info(
        "Tracing %s %s: %s at the rate of the %s calibration links, less if they are cached",
        f"{links:,}", what, time, f"{calibrated:,}",
    )  # fmt: skip


def _seconds(result: Record, links: int) -> float:
    """Estimated duration of a trace [s].

    The calibration may have taken its trace from the cache, so the estimate from the number of rays is a lower limit.
    """
    settings = result.study.trace
    lanes = 0 if settings.adaptive else settings.rays * max(settings.max_depth, 1) * links
    return max(result.cost.trace_seconds * links / len(result.links), lanes / LANES_PER_SECOND)
