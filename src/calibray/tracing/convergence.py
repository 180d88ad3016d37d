"""Checks whether a trace launched enough rays, by tracing again with twice as many rays and a different seed.

Rays find paths by chance. With more rays, fewer paths are missed, and diffuse reflection, an average over rays, has
less sampling noise. The change in path loss between the two traces is an estimate of the error of the first trace.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.paths import Paths
from calibray.tracing.settings import RANGES, TraceSettings

PathLoss = Callable[[Paths], NDArray[np.float64]]
"""A function, such as `calibray.path_loss`, that returns the path loss [L], [dB], of every link of a path program."""


@dataclass(frozen=True)
class Convergence:
    """The differences between a trace and a second trace with more rays.

    Attributes:
        samples: Number of rays per transmitter in the trace that was checked.
        change_db: Change in each link's path loss from the checked trace to the trace with more rays [L], [dB]. The
            change is 0 if neither trace has a path, -inf if only the trace with more rays has a path, and +inf if only
            the checked trace has a path.
        paths_before: Number of paths of every link in the checked trace [L].
        paths_after: Number of paths of every link in the trace with more rays [L].
    """

    samples: int
    change_db: NDArray[np.float64]
    paths_before: NDArray[np.int64]
    paths_after: NDArray[np.int64]

    @property
    def gained(self) -> NDArray[np.int64]:
        """Indices [n] of the links that have more paths than in the checked trace."""
        return np.flatnonzero(self.paths_after > self.paths_before)

    @property
    def lost(self) -> NDArray[np.int64]:
        """Indices [n] of the links that have fewer paths than in the checked trace."""
        return np.flatnonzero(self.paths_after < self.paths_before)

    @property
    def largest(self) -> NDArray[np.int64]:
        """Indices [L] of the links, ordered by the magnitude of their change, largest first."""
        return np.argsort(-np.abs(self.change_db), kind="stable")

    def quantile(self, share: float) -> float:
        """Quantile over the links of the magnitude of the change [dB]; a `share` of 0.5 gives the median.

        The quantile is +inf if too many links have a path in only one trace.
        """
        return float(np.quantile(np.abs(self.change_db), share, method="higher"))

    def converged(self, tolerance_db: float) -> bool:
        """Whether no link changed by more than a tolerance [dB]."""
        return self.quantile(1.0) <= tolerance_db


def compare(before: Paths, after: Paths, samples: int, path_loss: PathLoss) -> Convergence:
    """Compare the path loss of two traces of the same links; `before` has `samples` rays per transmitter.

    Raises:
        InputError: The links differ.
    """
    for name in ("tx_position", "rx_position"):
        if not np.array_equal(getattr(before, name), getattr(after, name)):
            raise InputError(
                f"the links of the two traces ({before.num_links} and {after.num_links}) differ in {name}; "
                "compare traces of the same links"
            )
    loss_before, loss_after = path_loss(before), path_loss(after)
    no_path = np.isinf(loss_before) & np.isinf(loss_after)
    return Convergence(
        samples=samples,
        # inf - inf is NaN, so the change of links that have no path in either trace is set to 0.
        change_db=np.where(no_path, 0.0, loss_after - np.where(no_path, 0.0, loss_before)),
        paths_before=np.bincount(before.link, minlength=before.num_links),
        paths_after=np.bincount(after.link, minlength=after.num_links),
    )


def check(
    settings: TraceSettings, trace: Callable[[TraceSettings], Paths], before: Paths, path_loss: PathLoss
) -> Convergence:
    """Trace links again with twice as many rays and the next seed, and compare the result with `before`.

    Args:
        settings: Settings with which `before` was traced.
        trace: Function that traces the same links with other settings.
        before: The paths to check.
        path_loss: Function that returns the path loss of every link [L], [dB].

    Raises:
        InputError: `before` contains other links, or its rays were added in rounds. If rays were added in rounds, the
            last round is already the check.
        EngineError: There are more paths than the tracer can store.
    """
    if settings.samples == "auto":
        raise InputError(
            "trace.samples = 'auto' needs no second trace, because its last round of rays is the check; the change in "
            "path loss is in settings['last_round_db'] of the paths"
        )
    # The largest seed is followed by 0.
    next_seed = (settings.seed + 1) % (RANGES["seed"][1] + 1)
    after = trace(replace(settings, samples=2 * settings.samples, seed=next_seed))
    return compare(before, after, settings.samples, path_loss)


def join(parts: Sequence[tuple[NDArray[np.int64], Convergence]]) -> Convergence:
    """Join the changes of links that were traced in parts; each part includes the indices of its links."""
    count = sum(len(links) for links, _ in parts)
    change = np.empty(count)
    before, after = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    for links, part in parts:
        change[links], before[links], after[links] = part.change_db, part.paths_before, part.paths_after
    return Convergence(parts[0][1].samples, change, before, after)
