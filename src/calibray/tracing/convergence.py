"""Whether a trace sent out enough rays: it is repeated with twice as many and another seed.

Rays find paths by chance: the more are sent out, the fewer paths are missed, and the less diffuse reflection, which is
an average over rays, scatters. What a second, finer trace changes is an estimate of what the first one lacks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.paths import Paths
from calibray.tracing.sionna import Links, Tracer


@dataclass(frozen=True)
class Convergence:
    """What tracing again with more samples changed.

    Attributes:
        samples: Rays per transmitter of the trace that was checked.
        change_db: Path loss of every link with more samples, minus that before [L], [dB]: 0 where neither trace has a
            path, -inf where the finer one alone has, +inf where the coarser one alone has.
        paths_before: Number of paths of every link [L].
        paths_after: The same with more samples [L].
    """

    samples: int
    change_db: np.ndarray
    paths_before: np.ndarray
    paths_after: np.ndarray

    @property
    def gained(self) -> np.ndarray:
        """Links that have more paths than before [links]."""
        return np.flatnonzero(self.paths_after > self.paths_before)

    @property
    def lost(self) -> np.ndarray:
        """Links that have fewer paths than before [links]."""
        return np.flatnonzero(self.paths_after < self.paths_before)

    @property
    def largest(self) -> np.ndarray:
        """Links by size of change, the largest first [L]."""
        return np.argsort(-np.abs(self.change_db), kind="stable")

    def quantile(self, share: float) -> float:
        """Size of change that a share of the links does not exceed.

        Args:
            share: The share, from 0 to 1: 0.5 for the median, 1 for the largest change.

        Returns:
            The change of one of the links, without sign [dB]; +inf if too many links have a path in one trace alone.
        """
        return float(np.quantile(np.abs(self.change_db), share, method="higher"))

    def converged(self, tolerance_db: float) -> bool:
        """Whether no link changed by more than a tolerance [dB]."""
        return self.quantile(1.0) <= tolerance_db


def compare(
    before: Paths, after: Paths, samples: int, combining: str = "power", bandwidth: float | None = None
) -> Convergence:
    """Compare two traces of the same links.

    Args:
        before: The paths found first.
        after: The paths found with more samples.
        samples: Rays per transmitter of the first trace.
        combining: How the paths of a link combine (see `calibray.path_loss`).
        bandwidth: Bandwidth [Hz], for "band".

    Returns:
        The change of every link.

    Raises:
        InputError: The links differ, or the combining is unknown.
    """
    for name in ("tx_position", "rx_position"):
        if not np.array_equal(getattr(before, name), getattr(after, name)):
            raise InputError(
                f"the traces have {before.num_links} and {after.num_links} links that differ in {name}; "
                "compare traces of the same links"
            )
    one, other = (path_loss(paths, combining=combining, bandwidth=bandwidth) for paths in (before, after))
    neither = np.isinf(one) & np.isinf(other)
    return Convergence(
        samples=samples,
        change_db=np.where(neither, 0.0, other - np.where(neither, 0.0, one)),
        paths_before=np.bincount(before.link, minlength=before.num_links),
        paths_after=np.bincount(after.link, minlength=after.num_links),
    )


def check(
    tracer: Tracer,
    links: Links,
    before: Paths,
    *,
    combining: str = "power",
    bandwidth: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Convergence:
    """Trace some links again with twice the samples and the next seed, and compare.

    Args:
        tracer: What traced them.
        links: The links.
        before: The paths that it found.
        combining: How the paths of a link combine (see `calibray.path_loss`).
        bandwidth: Bandwidth [Hz], for "band".
        progress: Called with (receivers traced, receivers in all) while tracing.

    Returns:
        The change of every link.

    Raises:
        InputError: The combining is unknown, or `before` holds other links.
        EngineError: There are more paths than the tracer can hold.
    """
    settings = tracer.settings
    finer = Tracer(
        tracer.scene,
        tracer.frequency,
        replace(settings, samples=2 * settings.samples, seed=settings.seed + 1),
        tracer.tx_antenna,
        tracer.rx_antenna,
    )
    return compare(before, finer.trace(links, progress).paths(), settings.samples, combining, bandwidth)
