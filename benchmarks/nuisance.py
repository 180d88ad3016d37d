"""Derivatives with the nuisance eliminated: one pass over all links compared with a loop over groups.

    python benchmarks/nuisance.py

The baseline uses a mask over all links for every group and every parameter. Both are timed in the same run on the same
numbers and must agree; designs that the baseline cannot express are listed without it.
"""

from __future__ import annotations

import argparse

import numpy as np

from calibray.fitting.nuisance import Nuisance, Term, make_term
from calibray.fitting.objective import Objective, make_objective
from calibray.measurements import Measurements
from timing import seconds


def former_jacobian(
    objective: Objective, group: np.ndarray, groups: int, loss: np.ndarray, slope: np.ndarray
) -> np.ndarray:
    """Derivatives minus their weighted means over groups, with a mask for each group; all links have weight."""
    gap = objective.measured - loss
    weight = np.where(np.isfinite(gap), objective.weight, 0.0)

    def per_group(value: np.ndarray) -> np.ndarray:
        return np.stack([value[:, group == k].sum(axis=1) for k in range(groups)], axis=1)

    offset = per_group(weight * gap) / per_group(weight)
    free = np.isfinite(offset)
    total = per_group(objective.weight[None])
    mean = np.stack([per_group(objective.weight * slope[..., k]) for k in range(slope.shape[2])], axis=-1)
    mean = mean / total[..., None] * free[..., None]
    left = slope - mean[:, group]
    return left * np.sqrt(objective.weight / objective.weight.mean())[:, None]


def campaign(count: int, groups: int) -> Measurements:
    """Links in groups, with individual weights."""
    rng = np.random.default_rng(0)
    return Measurements(
        tx=np.zeros((count, 3)),
        rx=rng.uniform(20, 2000, (count, 3)),
        path_loss_db=rng.uniform(80, 140, count),
        weight=rng.uniform(0.5, 2.0, count),
        group=np.array([f"{k:05}" for k in rng.integers(0, groups, count)]),
    )


def designs(links: Measurements) -> dict[str, tuple[Term, ...]]:
    """The nuisances measured."""

    def offset(**options: object) -> Term:
        return make_term(links, "offset", labels=links.group, **options)

    slope = make_term(links, "slope", "log_distance")
    slopes = make_term(links, "slopes", "log_distance", labels=links.group)
    return {
        "offset per group": (offset(),),
        "the same in bounds": (offset(bounds=(-3.0, 3.0)),),
        "and a slope": (offset(), slope),
        "and a slope per group": (offset(), slopes),
        "and a slope per group, in bounds": (offset(bounds=(-3.0, 3.0)), slopes),
        "with a prior, a slope, one for all": (make_term(links, "all"), offset(prior=3.0), slope),
    }


def main() -> None:
    """Measure and print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--links", type=float, default=1e5)
    options.add_argument("--groups", type=int, default=500)
    options.add_argument("--candidates", type=int, default=8)
    options.add_argument("--parameters", type=int, default=6)
    given = options.parse_args()
    count, groups = int(given.links), given.groups
    links, everything = campaign(count, groups), np.ones(count, dtype=bool)
    rng = np.random.default_rng(1)
    loss = rng.uniform(80, 140, (given.candidates, count))
    slope = rng.normal(size=(given.candidates, count, given.parameters))
    print(f"{count} links, {given.candidates} candidates, {given.parameters} parameters, {groups} groups\n")
    print(f"{'nuisance':36} {'jacobian':>10} {'value':>10} {'former / now':>13} {'difference':>11}")
    targets = {
        name: make_objective(links, everything, everything, nuisance=Nuisance(count, terms), noise_db=6.0)
        for name, terms in designs(links).items()
    }
    plain, group = targets["offset per group"], links.group_index
    rival = seconds(lambda: former_jacobian(plain, group, groups, loss, slope), 1)
    gap = abs(former_jacobian(plain, group, groups, loss, slope) - plain.jacobian(loss, slope)).max()
    for name, target in targets.items():
        time = seconds(lambda target=target: target.jacobian(loss, slope), 5)
        value = seconds(lambda target=target: target.value(loss), 5)
        rival_columns = f" {rival / time:12.0f}x {gap:11.1e}" if target is plain else ""
        print(f"{name:36} {1e3 * time:7.0f} ms {1e3 * value:7.0f} ms{rival_columns}")


if __name__ == "__main__":
    main()
