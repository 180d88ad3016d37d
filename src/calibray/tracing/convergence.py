"""Whether a trace sent out enough rays: it is repeated with twice as many and another seed.

Rays find paths by chance: the more are sent out, the fewer paths are missed, and the less diffuse reflection, which is
an average over rays, scatters. What a second, finer trace changes is an estimate of what the first one lacks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.paths import Paths
from calibray.support.progress import Progress
from calibray.tracing.protocol import Links, Tracer


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
    change_db: NDArray[np.float64]
    paths_before: NDArray[np.int64]
    paths_after: NDArray[np.int64]

    @property
    def gained(self) -> NDArray[np.int64]:
        """Links that have more paths than before [links]."""
        return np.flatnonzero(self.paths_after > self.paths_before)

    @property
    def lost(self) -> NDArray[np.int64]:
        """Links that have fewer paths than before [links]."""
        return np.flatnonzero(self.paths_after < self.paths_before)

    @property
    def largest(self) -> NDArray[np.int64]:
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


PathLoss = Callable[[Paths], NDArray[np.float64]]
"""Path loss of every link [L], [dB], of a path program; as `calibray.path_loss`."""


def compare(before: Paths, after: Paths, samples: int, path_loss: PathLoss) -> Convergence:
    """Compare two traces of the same links.

    Args:
        before: The paths found first.
        after: The paths found with more samples.
        samples: Rays per transmitter of the first trace.
        path_loss: Computes the path loss to compare.

    Returns:
        The change of every link.

    Raises:
        InputError: The links differ.
    """
    for name in ("tx_position", "rx_position"):
        if not np.array_equal(getattr(before, name), getattr(after, name)):
            raise InputError(
                f"the traces have {before.num_links} and {after.num_links} links that differ in {name}; "
                "compare traces of the same links"
            )
    one, other = path_loss(before), path_loss(after)
    neither = np.isinf(one) & np.isinf(other)
    return Convergence(
        samples=samples,
        change_db=np.where(neither, 0.0, other - np.where(neither, 0.0, one)),
        paths_before=np.bincount(before.link, minlength=before.num_links),
        paths_after=np.bincount(after.link, minlength=after.num_links),
    )


def check(
    tracer: Tracer, links: Links, before: Paths, path_loss: PathLoss, progress: Progress | None = None
) -> Convergence:
    """Trace some links again with twice the samples and the next seed, and compare.

    Args:
        tracer: What traced them.
        links: The links.
        before: The paths that it found.
        path_loss: Computes the path loss to compare.
        progress: Called with ("tracing", receivers traced, receivers in all).

    Returns:
        The change of every link.

    Raises:
        InputError: `before` holds other links, or its rays were added in rounds, of which the last one is the check.
        EngineError: There are more paths than the tracer can hold.
    """
    settings = tracer.settings
    if settings.samples == "auto":
        raise InputError(
            "trace.samples = 'auto' has no trace with twice the rays: its last round is one; what it changed is "
            "settings['last_round_db'] of the paths"
        )
    finer = tracer.with_settings(replace(settings, samples=2 * settings.samples, seed=settings.seed + 1))
    return compare(before, finer.trace(links, progress), settings.samples, path_loss)


def join(parts: Sequence[tuple[NDArray[np.int64], Convergence]]) -> Convergence:
    """What tracing again changed, of links that were traced apart.

    Args:
        parts: At least one record, each with the places that its links have among all; together they have every link
            once.

    Returns:
        One record of all links.
    """
    count = sum(len(links) for links, _ in parts)
    change = np.empty(count)
    before, after = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    for links, part in parts:
        change[links], before[links], after[links] = part.change_db, part.paths_before, part.paths_after
    return Convergence(parts[0][1].samples, change, before, after)
