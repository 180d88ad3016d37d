"""The interfaces of engines and observables, the answers of engines, and the check of candidates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from threading import Event
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from calibray.errors import EngineError, InputError
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.measurements.observables import Statistic
from calibray.parameters import Parameters
from calibray.support.progress import Progress


@runtime_checkable
class Engine(Protocol):
    """An engine computes the path loss of all links for candidates."""

    @property
    def calls(self) -> int:
        """Number of RT calls so far: one for each candidate that the engine has run."""
        ...

    @property
    def parameters(self) -> Parameters:
        """The parameters whose values a candidate contains."""
        ...

    @property
    def materials(self) -> dict[str, Material]:
        """The scene's materials before calibration."""
        ...

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss [n, L], [dB], for candidates [n, d] in the parameters' units; +inf for a link without a path.

        Raises:
            InputError: The candidates have the wrong number of columns, or a value is not a finite real number.
        """
        ...


@runtime_checkable
class Differentiable(Engine, Protocol):
    """An engine that computes derivatives."""

    @property
    def large(self) -> bool:
        """Whether the evaluation of a candidate takes milliseconds rather than microseconds."""
        ...

    @property
    def interactions(self) -> int:
        """Number of interactions that are evaluated for each candidate."""
        ...

    def path_loss_and_jacobian(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Path loss [n, L], [dB], and its derivatives with respect to the parameters [n, L, d], [dB] per unit.

        Raises:
            InputError: The candidates have the wrong number of columns, or a value is not a finite real number.
        """
        ...


@dataclass(frozen=True, eq=False)
class Responses:
    """Path loss and further observables of all links for n candidates.

    Attributes:
        path_loss: Path loss [n, L], [dB]; +inf for a link without a path.
        observed: Values [n, K, L] of K further observables, in SI units; NaN for a link without a value.
        loss_slope: Derivatives [n, L, d] of path loss with respect to the parameters; None if not requested.
        observed_slope: Derivatives [n, K, L, d] of the further observables; NaN for a link without a value. None if not
            requested.
    """

    path_loss: NDArray[np.float64]
    observed: NDArray[np.float64]
    loss_slope: NDArray[np.float64] | None = None
    observed_slope: NDArray[np.float64] | None = None

    def arrays(self) -> list[NDArray[np.float64]]:
        """Path loss and observables, followed by their derivatives where available."""
        every = self.path_loss, self.observed, self.loss_slope, self.observed_slope
        return [array for array in every if array is not None]


def joined(parts: Sequence[Responses]) -> Responses:
    """Combine the responses for successive batches of candidates."""
    columns = zip(*(part.arrays() for part in parts), strict=True)
    return Responses(*(np.concatenate(column) for column in columns))


def of_links(parts: Sequence[Responses], links: Sequence[NDArray[np.intp]]) -> Responses:
    """Combine the responses for subsets of the links; `links` contains the indices [l] of each subset's links."""
    count, arrays = sum(map(len, links)), []
    # Axis of the links in path loss, in observables, and in the derivatives of both quantities.
    for column, axis in zip(zip(*(part.arrays() for part in parts), strict=True), (1, 2, 1, 2), strict=False):
        shape = list(column[0].shape)
        shape[axis] = count
        every = np.empty(shape)
        for part, index in zip(column, links, strict=True):
            every[(slice(None),) * axis + (index,)] = part
        arrays.append(every)
    return Responses(*arrays)


@runtime_checkable
class Observing(Engine, Protocol):
    """An engine that computes further observables of the links."""

    def respond(
        self, candidates: NDArray[np.float64], wanted: tuple[Statistic, ...], derivatives: bool = False
    ) -> Responses:
        """Path loss and the statistics `wanted` of every link for candidates [n, d]; each candidate is one RT call.

        Raises:
            InputError: The candidates have the wrong number of columns, or a value is not a finite real number.
        """
        ...


Reduction = Callable[[NDArray[np.float64], NDArray[np.float64] | None], Any]
"""Reduces a chunk's path loss [n, l], [dB], and its derivatives [n, l, d] or None, to a few sums over the chunk's
links."""

Reduced = Callable[[NDArray[np.float64], bool], list[Any]]
"""Maps candidates [n, d], with a flag that requests derivatives, to the results of all chunks' reductions."""


@runtime_checkable
class Chunked(Differentiable, Protocol):
    """An engine whose links are divided into chunks, which may be kept on other machines."""

    @property
    def chunks(self) -> Sequence[NDArray[np.int64]]:
        """Indices of every chunk's links; every link belongs to exactly one chunk."""
        ...

    def reducing(self, reductions: Sequence[Reduction]) -> Reduced:
        """Make a function of candidates that reduces each chunk's path loss on its worker, so that little data is sent.

        Every chunk has its own reduction, which is sent to the chunk's worker once.
        """
        ...

    def ask(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Call a picklable function for every chunk on its worker, and return the results in the order of the chunks.

        The first argument is the chunk (`engines.cluster.chunks.Chunk`); the other arguments are the same for all
        chunks.
        """
        ...

    def derived(self, parameters: Parameters, derive: Callable[[Any], Differentiable]) -> Chunked:
        """The same chunks with engines for other parameters, made by the picklable function `derive`."""
        ...

    def traced_with(self, materials: Mapping[str, Material], progress: Progress | None = None) -> Chunked:
        """The same engine, but with its paths traced with other materials; `progress` is called after every chunk."""
        ...


@runtime_checkable
class ReplaysScene(Protocol):
    """An engine with stored paths that can omit effects, as needed to predict the path loss in an exported scene."""

    def scene_path_loss(
        self, candidates: NDArray[np.float64], walls: Mapping[str, str]
    ) -> NDArray[np.float64]:
        """Path loss [n, L], [dB], of the scene alone for candidates [n, d] in the parameters' units.

        Effects on paths, such as the loss in regions, are omitted. `walls` maps the name of every facade to the
        material that its wall has in the scene.
        """
        ...


@dataclass(frozen=True, eq=False)
class Answer:
    """An engine's answer to one candidate.

    Attributes:
        index: Index of the candidate in the batch.
        path_loss_db: Path loss [L], [dB]; +inf for a link without a path, and for all links of a failed call.
        seconds: Duration of the call [s].
        failure: Error message that names the engine and the candidate; empty if the call succeeded.
        rays: If the program returns rays, its unchanged response; otherwise, any further observables [K, L] in SI units
            as little-endian doubles; empty if there are neither.
        lost: Whether the call failed because its worker or guard ended, which is not the program's fault. The ledger
            does not store such a failure.
    """

    index: int
    path_loss_db: NDArray[np.float64]
    seconds: float
    failure: str = ""
    rays: bytes = b""
    lost: bool = False


@runtime_checkable
class Answering(Engine, Protocol):
    """An engine with expensive calls, which returns each answer in a batch as soon as it arrives.

    The method `path_loss` returns +inf for all links of a failed candidate. The method raises EngineError if every
    candidate of the first batch fails, if too many successive calls fail, or if the ledger or the files of a call
    cannot be written.
    """

    @property
    def num_links(self) -> int:
        """Number of links L."""
        ...

    def answers(self, candidates: NDArray[np.float64], stop: Event | None = None) -> Iterator[Answer]:
        """Yield the answer to each of the candidates [n, d], in the parameters' units, as soon as its call ends.

        After another thread sets `stop`, no further call starts, and running calls are stopped if possible. Answers
        that have already arrived by then are still yielded.

        Raises:
            InputError: A value is unphysical.
            EngineError: Too many successive calls failed, or a call's files cannot be written; all earlier answers have
                been yielded.
        """
        ...


def gather(answers: Iterable[Answer], shape: tuple[int, int], first: bool) -> NDArray[np.float64]:
    """Collect the path loss [n, L], [dB], of a batch of answers; +inf for all links of a failed candidate.

    If the whole first batch fails, the engine itself is assumed to be at fault.

    Raises:
        EngineError: Every candidate of the first batch failed.
    """
    losses, failures = np.full(shape, np.inf), []
    for answer in answers:
        losses[answer.index] = answer.path_loss_db
        if answer.failure:
            failures.append(answer.failure)
    if first and len(failures) == shape[0]:
        more = f"; all {len(failures)} candidates of the first batch failed" if len(failures) > 1 else ""
        raise EngineError(f"{failures[0]}{more}")
    return losses


def gather_responses(
    answers: Iterable[Answer], shape: tuple[int, int], num_observables: int, first: bool
) -> Responses:
    """Collect path loss and further observables of a batch of answers; observables are NaN for a failed candidate.

    Raises:
        EngineError: Every candidate of the first batch failed.
    """
    answers, (count, num_links) = list(answers), shape
    observed = np.full((count, num_observables, num_links), np.nan)
    for answer in answers:
        if not answer.failure:
            observed[answer.index] = np.frombuffer(answer.rays, "<f8").reshape(num_observables, num_links)
    return Responses(gather(answers, shape, first), observed)


def check_candidates(candidates: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Check candidates [n, d], and return them as an array of floats.

    Raises:
        InputError: The shape is wrong, or a value is not a finite real number.
    """
    values = np.asarray(candidates)
    if values.dtype.kind not in "fiu":
        raise InputError(f"candidates: values are of type {values.dtype}; they must be real numbers")
    if values.ndim != 2 or values.shape[1] != width or not len(values):
        raise InputError(
            f"candidates: the array has shape {values.shape}; it must have shape (n, {width}) with n at least 1"
        )
    values = values.astype(float, copy=False)
    if not np.isfinite(values).all():
        raise InputError("candidates: a value is not finite; give finite numbers within the bounds")
    return values


@dataclass(frozen=True)
class Observable:
    """A quantity of a link that is both measured and modelled.

    Attributes:
        name: Name in messages.
        unit: Unit of the values.
        measured: Function that maps links to measured values [L].
        modelled: Function that maps an engine and candidates [n, d] to values [n, L]; +inf for a link without a path.
        derivatives: Function that maps an engine and candidates [n, d] to values [n, L] and their derivatives [n, L, d]
            with respect to the parameters; None if there are no derivatives.
    """

    name: str
    unit: str
    measured: Callable[[Measurements], NDArray[np.float64]]
    modelled: Callable[[Engine, NDArray[np.float64]], NDArray[np.float64]]
    derivatives: (
        Callable[[Differentiable, NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
        | None
    ) = None


def _path_loss(engine: Engine, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Path loss [n, L], [dB], of any engine.

    Raises:
        EngineError: The answer is not an array of numbers with one row per candidate, or a number is NaN or -inf.
    """
    loss, count = engine.path_loss(candidates), len(candidates)
    if not isinstance(loss, np.ndarray) or loss.ndim != 2 or len(loss) != count or loss.dtype.kind != "f":
        shape = f" of shape {loss.shape} and type {loss.dtype}" if isinstance(loss, np.ndarray) else ""
        raise EngineError(
            f"the engine {type(engine).__name__} returned a {type(loss).__name__}{shape} from path_loss; it must be a "
            f"NumPy array of floats with {count} rows, one per candidate, and one column per link"
        )
    if not (loss > -np.inf).all():
        link = int(np.flatnonzero(~(loss > -np.inf).all(axis=0))[0])
        raise EngineError(
            f"the engine {type(engine).__name__} returned NaN or -inf for the path loss of link {link}, counted from "
            "0; return inf for a link without a path"
        )
    return loss


PATH_LOSS: Final = Observable(
    "path loss",
    "dB",
    measured=lambda links: links.path_loss_db,
    modelled=_path_loss,
    derivatives=lambda engine, candidates: engine.path_loss_and_jacobian(candidates),
)
"""Path loss [dB], the observable that the paper uses for calibration."""
