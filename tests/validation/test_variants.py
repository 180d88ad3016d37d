"""Variants of a model: offsets of transmitters and of links out of sight, priors, and starting points of searches."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import planted
from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.objective import Objective
from calibray.fitting.problem import Problem
from calibray.measurements import Measurements, SourceTable
from calibray.result.held_out import Model
from calibray.scenes.obstruction import OUT_OF_SIGHT
from calibray.study import Setup, Study
from calibray.validation import models
from calibray.validation.models import TX_OFFSET, with_offsets
from link_tables import links_from_frame

COUNT = 120


def links(transmitters: int = 2, out_of_sight: bool = True) -> tuple[Measurements, np.ndarray, np.ndarray]:
    """Links, their transmitters, and which are out of sight."""
    random = np.random.default_rng(5)
    tx, blocked = random.integers(transmitters, size=COUNT), random.random(COUNT) < 0.4
    columns = {OUT_OF_SIGHT: blocked.astype(float)} if out_of_sight else {}
    rows = pd.DataFrame(columns, index=range(COUNT))
    table = Measurements(
        tx=np.column_stack([50.0 * tx, np.zeros(COUNT), np.full(COUNT, 10.0)]),
        rx=np.column_stack([random.uniform(0, 300, (COUNT, 2)), np.full(COUNT, 1.5)]),
        path_loss_db=np.full(COUNT, 100.0),
        table=SourceTable(rows),
    )
    return table, tx, blocked


def coefficients(
    measured: np.ndarray, table: Measurements, noise_db: float = 1.0
) -> dict[str, dict[str, float]]:
    """Coefficients of the variant's terms if the model predicts 0 dB."""
    objective = with_offsets(Objective(measured, np.ones(COUNT), Nuisance(COUNT, ()), None, noise_db), table)
    found = objective.coefficients(np.zeros((1, COUNT)))[0]
    return objective.nuisance.by_term(found, objective.determined)


def test_planted_offsets_are_estimated() -> None:
    table, tx, blocked = links()
    noise = np.random.default_rng(6).normal(size=COUNT)
    offset = coefficients(3.0 + np.where(tx == 0, -4.0, 4.0) + 12.0 * blocked + noise, table)
    below, above = offset[TX_OFFSET].values()
    assert above - below == pytest.approx(8.0, abs=0.6)
    assert above + below == pytest.approx(0.0, abs=0.1)  # the prior centres the offsets on that of all links
    assert offset["constant of all links"][""] == pytest.approx(3.0, abs=0.5)
    assert offset[f"{OUT_OF_SIGHT} of all links"][""] == pytest.approx(12.0, abs=0.6)


def test_the_prior_keeps_offsets_small_where_the_data_do_not_need_them() -> None:
    table, *_ = links()
    noise = 30.0 * np.random.default_rng(7).normal(size=COUNT)
    certain, uncertain = coefficients(noise, table), coefficients(noise, table, noise_db=1000.0)
    for name in (TX_OFFSET, f"{OUT_OF_SIGHT} of all links"):
        assert max(map(abs, uncertain[name].values())) < 0.1 * max(map(abs, certain[name].values()))


def test_without_groups_and_obstruction_there_is_no_such_variant() -> None:
    table, *_ = links(transmitters=1, out_of_sight=False)
    plain = Objective(np.zeros(COUNT), np.ones(COUNT), Nuisance(COUNT, ()))
    assert with_offsets(plain, table) is None
    table, tx, _ = links(out_of_sight=False)
    grouped = make_term(table, "offset", labels=tx.astype(str))
    assert with_offsets(Objective(plain.measured, plain.weight, Nuisance(COUNT, (grouped,))), table) is None


def test_a_prior_keeps_the_materials_near_the_initial_ones() -> None:
    setup = Setup.open(
        Study.from_content(planted.content("links.csv")), links=links_from_frame(planted.links())
    )
    part = Problem.of(setup, planted.engine())
    noise_db = 3 * np.random.default_rng(2).standard_normal(planted.LINKS)
    part = replace(part, objective=replace(part.objective, measured=planted.path_loss() + noise_db))
    start = part.parameters.to_search(part.parameters.start)
    fits = models.fit_variants(part)
    prior, free = (np.linalg.norm(fits[name][1][0] - start) for name in (Model.PRIOR, Model.CALIBRATED))
    assert 0 < prior < 0.7 * free


@pytest.mark.parametrize(("searches", "additional"), [(16, 1), (32, 2), (512, 4)])
def test_a_large_program_has_fewer_additional_starts(
    monkeypatch: pytest.MonkeyPatch, searches: int, additional: int
) -> None:
    used: list[int] = []

    def without_search(problem: object, starts: np.ndarray, new_starts: int) -> np.ndarray:
        used.append(new_starts)
        return starts

    known = np.zeros((1, 2))
    monkeypatch.setattr(models, "local_searches", lambda _: searches)
    monkeypatch.setattr(models, "find_minima", without_search)
    monkeypatch.setattr(models, "variants", lambda part, best: {Model.CALIBRATED: part, Model.PRIOR: part})
    part: Any = SimpleNamespace(engine=None)
    models.fit_variants(part, {Model.CALIBRATED: known})
    models.fit_variants(part, {Model.CALIBRATED: known, Model.PRIOR: known})
    # A variant without minima over more links starts from those of the study's own model, and gets all.
    assert used == [additional, 4, additional, additional]
