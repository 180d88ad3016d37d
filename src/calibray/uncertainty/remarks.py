"""What a calibration's draws give reason to say aloud, a sentence each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.uncertainty.importance_sampling import Draws
from calibray.uncertainty.intervals import Interval
from calibray.uncertainty.noise_models import CORRELATED, DIFFERING, GAUSSIAN, HEAVY

SURE: Final = 0.5
"""Weight from which on a departure from independent Gaussian errors is said aloud."""

SLACK: Final = 0.02
"""Share of a parameter's range within which a value beside an interval is taken to lie in it."""

MOST: Final = 1000.0
"""Ratio beyond which how much more likely something is is not told."""

ROUGH: Final = (
    "Draws that explain the data are too few among so many parameters: intervals are rough, and a place that fits may "
    "be missing. Calibrate fewer parameters, or give them priors."
)
"""Said where the posterior was flattened."""

DEPARTURES: Final = {
    CORRELATED: "Errors of neighbouring links are alike",
    HEAVY: "Errors have heavy tails, as outliers make them",
    DIFFERING: "Errors grow where materials matter more, as where walls of one material differ",
}

CAUSES: Final = {
    CORRELATED: "errors that neighbours share make many links count as few",
    HEAVY: "links far off count less where errors have heavy tails",
    DIFFERING: "links that lean on walls count less where walls of one material differ",
    GAUSSIAN: "errors differ in a way that squares do not tell",
}
"""Why what explains the links best has not the least sum of squares, by the kind of noise that most speaks for."""


def departures(noise: Mapping[str, float]) -> tuple[str, ...]:
    """Said where errors are likely not independent and Gaussian.

    Args:
        noise: Weights of the kinds of noise.

    Returns:
        A sentence for each kind that is likely.
    """
    return tuple(
        f"{said} (weight {noise[kind]:.2f}, independent Gaussian errors {noise.get(GAUSSIAN, 0.0):.2f}); intervals "
        "allow for it."
        for kind, said in DEPARTURES.items()
        if noise.get(kind, 0.0) > SURE
    )


def missed(problem: Problem, posterior: Draws, trail: Trail) -> tuple[str, ...]:
    """Said where draws lie below what the method found.

    Args:
        problem: The problem.
        posterior: The draws.
        trail: The finished search.

    Returns:
        A sentence, or none.
    """
    top = posterior.point[np.argsort(-posterior.density)[:16]]
    lowest = float(problem.squares(top).value.min())
    if lowest > trail.best_value - 0.01:
        return ()
    return (
        f"The method missed the optimum: draws reach {lowest:.2f} dB, it found {trail.best_value:.2f} dB; intervals "
        "are those around the optimum.",
    )


def contradicted(
    problem: Problem,
    found: Mapping[str, float],
    told: Mapping[str, Interval],
    likeliest: Mapping[str, float],
    behind: float,
    noise: Mapping[str, float],
) -> tuple[str, ...]:
    """Said where a value that fits best by its squares lies outside its own interval.

    Args:
        problem: The problem.
        found: The values of the least RMSE, by parameter.
        told: The intervals.
        likeliest: The values of the best draw, by parameter.
        behind: Logarithm of the density of the best draw over that of the least RMSE.
        noise: Weights of the kinds of noise.

    Returns:
        What disagrees and why, and what to do; nothing where none does.
    """
    outside = []
    for parameter in problem.parameters:
        value, pieces = found[parameter.name], told[parameter.name].pieces
        slack = SLACK * (parameter.upper - parameter.lower)
        if pieces and not any(low - slack <= value <= high + slack for low, high in pieces):
            ranges = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in pieces)
            outside.append(
                f"{parameter.name} {value:.4g}, interval {ranges}, likeliest {likeliest[parameter.name]:.4g}"
            )
    if not outside:
        return ()
    kinds = {kind: noise.get(kind, 0.0) for kind in CAUSES}
    cause = CAUSES[max(kinds, key=kinds.__getitem__)]
    holdout = problem.setup.study.holdout
    advice = "Do not take the values of the least RMSE for the materials'; blocks held out tell what predicts best."
    if holdout is None or holdout.where is not None:
        advice = (
            "Predictions go by the values of the least RMSE unless blocks held out speak for another model: say "
            "[holdout] blocks = 4, and do not take these values for the materials'."
        )
    ratio = float(np.exp(np.clip(behind, 0.0, np.log(MOST))))
    times = f"more than {MOST:,.0f}" if ratio >= 0.999 * MOST else f"{ratio:.2g}"
    return (
        f"The least RMSE is not where the links are explained best: {'; '.join(outside)}. The RMSE takes the errors of "
        f"all links as independent; intervals do not, for {cause}, and the likeliest values are {times} times as "
        "likely.",
        advice,
    )
