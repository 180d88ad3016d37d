"""What every engine offers, what no engine accepts, and answers as they arrive."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from threading import Event
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from calibray.errors import EngineError, InputError
from calibray.materials import Material
from calibray.parameters import Parameters
from calibray.support.progress import Progress


@runtime_checkable
class Engine(Protocol):
    """What a calibration runs on."""

    @property
    def calls(self) -> int:
        """RT calls so far: candidates that the engine has run over all links."""
        ...

    @property
    def parameters(self) -> Parameters:
        """The parameters that a candidate's components stand for."""
        ...

    @property
    def materials(self) -> dict[str, Material]:
        """The scene's materials before calibration."""
        ...

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates [n, d] in the fields' units; [n, L], [dB], +inf without a path."""
        ...


@runtime_checkable
class Differentiable(Engine, Protocol):
    """An engine that gives derivatives."""

    @property
    def large(self) -> bool:
        """Whether a candidate costs milliseconds rather than microseconds."""
        ...

    @property
    def interactions(self) -> int:
        """Interactions that a candidate is evaluated at."""
        ...

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss [n, L], [dB], and its derivatives by the parameters [n, L, d]."""
        ...


Reduction = Callable[[NDArray[np.float64], NDArray[np.float64] | None], Any]
"""Path loss [n, l] of a block's links and its derivatives [n, l, d], if asked for, to what is wanted of them."""

Reduced = Callable[[NDArray[np.float64], bool], list[Any]]
"""Candidates [n, d], and whether derivatives are taken, to what the reduction of every block gave."""


@runtime_checkable
class Parted(Differentiable, Protocol):
    """An engine whose links are parted into blocks, which may live on other machines."""

    @property
    def blocks(self) -> Sequence[NDArray[np.int64]]:
        """Links of every block; together they hold every link once."""
        ...

    def reducing(self, reductions: Sequence[Reduction]) -> Reduced:
        """What reduces the path loss of every block where that lives, so that only what is wanted of it comes back.

        Args:
            reductions: One for every block, sent there once.

        Returns:
            The function of candidates in the fields' units.
        """
        ...

    def traced_with(self, materials: Mapping[str, Material], progress: Progress | None = None) -> Parted:
        """The same engine on paths traced with other materials.

        Args:
            materials: Constants in place of the scene's, by material name.
            progress: Called with the stage "tracing" whenever a block is traced.

        Returns:
            Another engine.
        """
        ...


@dataclass(frozen=True, eq=False)
class Answer:
    """What an engine answered to one candidate.

    Attributes:
        index: Place of the candidate in the batch.
        path_loss_db: Path loss [L], [dB]; +inf where a link has no path, and for all links of a failed call.
        seconds: Time that the engine took [s].
        failure: What went wrong, with the place; empty if nothing did.
    """

    index: int
    path_loss_db: NDArray[np.float64]
    seconds: float
    failure: str = ""


@runtime_checkable
class Answering(Engine, Protocol):
    """An engine whose calls are dear: it gives each answer of a batch as soon as it is there."""

    @property
    def num_links(self) -> int:
        """Number of links L."""
        ...

    def answers(self, candidates: NDArray[np.float64], stop: Event | None = None) -> Iterator[Answer]:
        """The answers to candidates [n, d] in the fields' units, in the order in which they arrive.

        Where `stop` is set from outside, no further call is begun; what was answered by then is still given.
        """
        ...


def gather(answers: Iterable[Answer], shape: tuple[int, int], first: bool) -> NDArray[np.float64]:
    """The path loss of a batch from its answers, in whatever order they arrive.

    Args:
        answers: One answer per candidate.
        shape: Number of candidates n and of links L.
        first: Whether this is the first batch; if all of it fails, the engine is taken to be at fault.

    Returns:
        Path loss [n, L], [dB]; +inf for all links of a candidate that failed.

    Raises:
        EngineError: Every candidate of the first batch failed.
    """
    losses, failures = np.full(shape, np.inf), []
    for answer in answers:
        losses[answer.index] = answer.path_loss_db
        if answer.failure:
            failures.append(answer.failure)
    if first and len(failures) == shape[0]:
        more = f"; so did all {len(failures)} candidates of the first batch" if len(failures) > 1 else ""
        raise EngineError(f"{failures[0]}{more}")
    return losses


def check_candidates(candidates: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Candidates as an array, refused if they cannot be evaluated.

    Args:
        candidates: Parameter values [n, d].
        width: Number of parameters d.

    Returns:
        The values [n, d].

    Raises:
        InputError: The shape is another, or a value is not finite.
    """
    values = np.asarray(candidates, dtype=float)
    if values.ndim != 2 or values.shape[1] != width or not len(values):
        raise InputError(f"candidates: shape {values.shape}, must be (n, {width}) with n at least 1")
    if not np.isfinite(values).all():
        raise InputError("candidates: hold a value that is not finite; give numbers within the bounds")
    return values
