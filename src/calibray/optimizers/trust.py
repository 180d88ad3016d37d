"""Whether a cheap model helps: judged by predictions of answers that nothing in them was fitted to.

A cheap model with many free constants explains the few answers that these were fitted to, whatever it is. So two kinds
of predictions are compared with those of the same process without a cheap model:

- *foretold*: what was said of each step before it was answered (A. P. Dawid, J. R. Stat. Soc. A 147 (1984) 278);
- *left out*: each answer predicted from all the others, the constants and all else fitted to those alone.

The first owns up to promises, but keeps blaming a model for constants that it has long learned; the second does not,
but tells little while answers are few and each is far from the others. The verdict is the mean of the two: of the
logarithm of squared errors with the cheap model by those without, over all links, so that no few of them rule it. After
every call the verdict is added to the doubt, which is never less than none (a cumulative sum: E. S. Page, Biometrika 41
(1954) 100). So one bad step is forgiven, and a model that is far worse than none is given up at once.

On planted problems of the development seeds a cheap model of their own stayed, with a doubt of at most 0.6 from three
answers on, in 29 of 30 runs; in one, of two parameters and told wrong constants, it was given up after four. Of 45 runs
with cheap models that know nothing it was given up after three answers in 32, after four in 8 and after five in 2; in
three it foretold about as well as none and stayed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers import discrepancy
from calibray.optimizers.corrected import Corrected, correct
from calibray.optimizers.discrepancy import Discrepancy, Seen

VERDICTS: Final = 5
"""Verdicts on a cheap model; later ones are on points so close that any process predicts them."""

LEFT_OUT: Final = 6
"""Most answers that are predicted from all the others."""

SLIGHT: Final = 0.01
"""Share of the mean squared error without it that a link's is raised by, so that links at rest say nothing."""

SINGLE: Final = 0.9
"""Most that one verdict adds to the doubt."""

DOUBTED: Final = 1.0
"""Doubt beyond which it is given up: no single verdict does that."""

ENOUGH: Final = 3
"""Answers from which on a finished search tells whether it misled."""

MISLED: Final = 2.0
"""Ratio beyond which it did; points near a minimum stand so close together that any process predicts them."""


@dataclass
class Trust:
    """What predictions with and without a cheap model came to.

    Attributes:
        foretold: Errors of what was foretold, with it and without, of every answer [m].
        doubt: Sum of the verdicts since it was last none.
        verdicts: Their number.
        answers: Answers that the last one was passed on.
    """

    foretold: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = field(default_factory=list)
    doubt: float = 0.0
    verdicts: int = 0
    answers: int = 1

    @property
    def lost(self) -> bool:
        """Whether the cheap model is to be given up."""
        return self.doubt > DOUBTED

    def note(
        self, mean: NDArray[np.float64], plain: NDArray[np.float64], residuals: NDArray[np.float64]
    ) -> None:
        """Take in a step.

        Args:
            mean: Residuals foretold with the cheap model [m].
            plain: Those foretold without [m].
            residuals: What was answered [m].
        """
        self.foretold.append((residuals - mean, residuals - plain))

    def judge(self, corrected: Corrected, cloud: NDArray[np.float64], *, noisy: bool = False) -> None:
        """Judge the cheap model by all answers so far, if there are two, more than before, and it is early.

        Args:
            corrected: The cheap model, corrected by them.
            cloud: Points spread over the unit cube, at which its response is measured [k, d].
            noisy: Whether the answers scatter.
        """
        if len(corrected.residuals) <= self.answers or self.verdicts == VERDICTS:
            return
        self.verdicts, self.answers = self.verdicts + 1, len(corrected.residuals)
        verdicts = [verdict(*left_out(corrected, cloud, noisy=noisy))]
        if self.foretold:
            verdicts.append(verdict(*np.moveaxis(np.array(self.foretold), 1, 0)))
        self.doubt = max(0.0, self.doubt + min(float(np.mean(verdicts)), SINGLE))


def left_out(
    corrected: Corrected, cloud: NDArray[np.float64], *, noisy: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Predict answers, each from all the others, with a cheap model and without.

    Args:
        corrected: The cheap model, corrected by two answers or more.
        cloud: Points spread over the unit cube, at which its response is measured [k, d].
        noisy: Whether the answers scatter.

    Returns:
        Errors with the cheap model, its constants fitted anew to the others, and without, of `LEFT_OUT` answers from
        the first to the last, or of all [n, m].
    """
    model, unit, residuals = corrected.model, corrected.rest.seen.unit, corrected.residuals
    errors = []
    for row in np.unique(np.linspace(0, len(unit) - 1, LEFT_OUT).astype(np.int64)):
        others = np.arange(len(unit)) != row
        seen, answers, point = unit[others], residuals[others], unit[row : row + 1]
        start = model.constants.centre[None]
        fewer = correct(model, corrected.box, seen, answers, cloud, start, noisy=noisy)
        alone = without(seen, answers, noisy=noisy)
        predicted = fewer.predict(point)[0][0], alone.predict(unseen(point))[0][0]
        errors.append(residuals[row] - np.array(predicted))
    with_it, plain = np.moveaxis(np.array(errors), 1, 0)
    return with_it, plain


def misleading(corrected: Corrected) -> float:
    """How much a cheap model misled a search, the constants kept that all its answers were fitted to.

    Args:
        corrected: The cheap model, corrected by three answers or more.

    Returns:
        Squared errors of answers predicted from all the others with it, by those without: the median of the links.
        Below 1 it helps.
    """
    alone = without(corrected.rest.seen.unit, corrected.residuals)
    with_it, plain = (np.sum(rest.left_out() ** 2, axis=0) for rest in (corrected.rest, alone))
    return float(np.median(with_it / np.maximum(plain, 1e-300)))


def without(unit: NDArray[np.float64], residuals: NDArray[np.float64], *, noisy: bool = False) -> Discrepancy:
    """The process of what remains, of a cheap model that says nothing.

    Args:
        unit: The points evaluated, in the unit cube [n, d].
        residuals: The answers [n, m].
        noisy: Whether the answers scatter.

    Returns:
        The process.
    """
    spread = residuals.std(axis=0) if len(unit) > 1 else np.sqrt(np.mean(residuals**2, axis=1))
    return discrepancy.fit(unseen(unit), residuals, max(float(spread.max()), 1e-12), noisy=noisy)


def unseen(unit: NDArray[np.float64]) -> Seen:
    """Points of which a cheap model says nothing.

    Args:
        unit: In the unit cube [n, d].

    Returns:
        The points as the process sees them.
    """
    return Seen(unit, np.zeros((len(unit), 0)))


def verdict(with_it: NDArray[np.float64], alone: NDArray[np.float64]) -> float:
    """What errors with a cheap model come to beside those without.

    Args:
        with_it: Errors with it [n, m].
        alone: Errors without [n, m].

    Returns:
        The logarithm of the squared error of a link with it by that without, mean over the links. Below 0 it helps.
    """
    square, beside = (np.sum(part**2, axis=0) for part in (with_it, alone))
    least = max(SLIGHT * float(beside.mean()), 1e-12)
    return float(np.mean(np.log((square + least) / (beside + least))))
