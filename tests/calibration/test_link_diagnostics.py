"""Leverage against closed forms, a planted region of extra loss, and planted differences between devices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import shapely

import two_ray
from calibray.calibration.link_diagnostics import differing_groups, groups_remark, leverage, region_remark
from calibray.engines import Replay
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.result.verdict import RemarkKind
from calibray.result.wording import remark_text
from calibray.scenes.obstruction import Region
from calibray.study import Setup


def test_leverage_of_a_mean_is_shared_and_of_a_single_link_is_one():
    offset = np.zeros((5, 2))
    offset[:4, 0] = offset[4, 1] = 1.0
    assert leverage(np.zeros((5, 1)), offset) == pytest.approx([0.25] * 4 + [1.0])


def test_leverage_is_the_projection_and_sums_to_the_unknowns():
    random = np.random.default_rng(0)
    design = np.ones((30, 1))
    jacobian = random.standard_normal((30, 3))
    jacobian -= jacobian.mean(axis=0)  # as with the offset eliminated
    columns = np.hstack([jacobian, design])
    hat = columns @ np.linalg.solve(columns.T @ columns, columns.T)
    found = leverage(jacobian, design)
    assert found == pytest.approx(np.diag(hat))
    assert found.sum() == pytest.approx(4.0)


def test_dependent_columns_count_once():
    column = np.arange(1.0, 7.0)[:, None]
    assert leverage(np.hstack([column, 2 * column]), np.zeros((6, 0))).sum() == pytest.approx(1.0)


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """Links all around, with two columns that name the phone."""
    folder = tmp_path_factory.mktemp("study")
    study = two_ray.study(folder, links=200, objective={"combining": "power"})
    random = np.random.default_rng(0)
    table = pd.read_csv(folder / "links.csv")
    table[["rx_x", "rx_y"]] = random.uniform(-120, 120, (200, 2))
    table["phone"] = random.choice(["a", "b", "c"], 200)
    table["serial"] = table["phone"].map({"a": 4, "b": 7, "c": 9})
    table.to_csv(folder / "links.csv", index=False)
    setup = Setup.open(study, tracer=two_ray.TwoRay)
    return Problem.of(setup, Replay(setup.trace(), setup.parameters))


def test_a_loss_where_the_scene_has_nothing_is_a_remark_only_if_planted(problem: Problem) -> None:
    truth, random = np.array([two_ray.TRUTH]), np.random.default_rng(1)
    modelled = problem.modelled(problem.parameters.to_search(truth[None]))
    belt = Region(np.array([shapely.box(20, -90, 40, -10)]), np.zeros(1), np.full(1, 10.0))
    links = problem.setup.links
    length = belt.length_inside(links.tx, links.rx)

    def remarks(loss_db_per_m: float) -> tuple:
        loss = modelled[0] + random.normal(0, 3, 200) + loss_db_per_m * length
        trail = Trail(best=truth, best_modelled=modelled[0])
        return region_remark(replace(problem, objective=replace(problem.objective, measured=loss)), trail)

    assert remarks(0.0) == ()
    (remark,) = remarks(0.8)
    assert remark.kind == RemarkKind.MISSING_REGION
    assert remark.values["west"] < 40
    assert remark.values["east"] > 20
    text = remark_text(remark)
    assert text.startswith(f"Losses of {remark.values['attenuation']:.2g} dB/m within x = ")
    assert "state them under [regions]" in text


def test_a_column_that_explains_residuals_is_named_only_if_planted(problem: Problem) -> None:
    truth, random = np.array([two_ray.TRUTH]), np.random.default_rng(2)
    modelled = problem.modelled(problem.parameters.to_search(truth[None]))[0]

    def remarks(step_db: float) -> tuple:
        slow = (problem.setup.links.frame["phone"] == "b").to_numpy()
        loss = modelled + random.normal(0, 3, 200) + step_db * slow
        trail = Trail(best=truth, best_modelled=modelled)
        return groups_remark(replace(problem, objective=replace(problem.objective, measured=loss)), trail)

    assert remarks(0.0) == ()
    (remark,) = remarks(5.0)
    assert remark.kind == RemarkKind.DIFFERING_GROUPS
    assert remark.values["others"] == ["serial"]
    text = remark_text(remark)
    assert "column 'phone'" in text
    assert "'b' +" in text
    assert text.endswith('[offset] per = "phone".')


def test_differences_and_losses_are_in_decibels_whatever_the_weights(problem: Problem) -> None:
    """Links with stated errors: the precise ones weigh 36 times as much as the others."""
    truth, random = np.array([two_ray.TRUTH]), np.random.default_rng(2)
    modelled = problem.modelled(problem.parameters.to_search(truth[None]))[0]
    links, trail = problem.setup.links, Trail(best=truth, best_modelled=modelled)
    slow = (links.frame["phone"] == "b").to_numpy()
    std, equal = np.where(slow, 1.0, 6.0), problem.objective
    belt = Region(np.array([shapely.box(20, -90, 40, -10)]), np.zeros(1), np.full(1, 10.0))
    loss = modelled + std * random.normal(size=200)
    stepped = replace(equal, measured=loss + 8.0 * slow, weight=equal.weight / std**2)
    (remark,) = groups_remark(replace(problem, objective=stepped), trail)
    index = remark.values["labels"].index("b")
    error = remark.values["errors_db"][index]
    assert remark.values["differences_db"][index] == pytest.approx(8.0, abs=3 * error)
    assert error < 1.0
    lossy = replace(equal, measured=loss + 2.0 * belt.length_inside(links.tx, links.rx))
    weighted = replace(lossy, weight=stepped.weight)
    one, other = (region_remark(replace(problem, objective=each), trail) for each in (lossy, weighted))
    assert one == other


def test_levels_of_the_signal_are_no_groups(problem: Problem) -> None:
    truth, links = np.array([two_ray.TRUTH]), problem.setup.links
    modelled = problem.modelled(problem.parameters.to_search(truth[None]))[0]
    loss = modelled + np.random.default_rng(4).normal(0, 3, 200)
    bars = np.digitize(loss, np.quantile(loss, [0.2, 0.4, 0.6, 0.8]))
    measured = replace(problem.objective, measured=loss)
    frame = links.frame.drop(columns=["phone", "serial"]).assign(bars=bars)

    def remarks(frame: pd.DataFrame) -> tuple:
        own = replace(links, table=replace(links.table, frame=frame), path_loss_db=loss)
        changed = replace(problem, setup=replace(problem.setup, links=own), objective=measured)
        return groups_remark(changed, Trail(best=truth, best_modelled=modelled))

    assert remarks(frame) == ()
    # Columns whose names stand twice, and complex numbers, are left out.
    assert remarks(pd.concat([frame, frame[["bars"]].astype(str)], axis=1)) == ()
    assert remarks(frame.assign(bars=frame["bars"] * 1j)) == ()
    # As texts they would be named.
    (remark,) = remarks(frame.assign(bars=frame["bars"].astype(str)))
    assert remark.values["column"] == "bars"


def test_carriers_that_share_an_offset_are_named_though_they_are_no_whole_numbers(problem: Problem) -> None:
    truth, links, study = np.array([two_ray.TRUTH]), problem.setup.links, problem.setup.study
    modelled = problem.modelled(problem.parameters.to_search(truth[None]))[0]
    carrier = np.random.default_rng(5).choice([763.0, 1842.5], 200)
    loss = modelled + np.random.default_rng(6).normal(0, 3, 200) + 5.0 * (carrier > 1000)
    frame = links.frame.drop(columns=["phone", "serial"]).assign(**{"f [MHz]": carrier})
    own = replace(links, table=replace(links.table, frame=frame), path_loss_db=loss)
    measured = replace(problem.objective, measured=loss)

    def remarks(frequency: str | None) -> tuple:
        section = study.links.model_copy(update={"frequency": frequency})
        setup = replace(problem.setup, links=own, study=study.model_copy(update={"links": section}))
        changed = replace(problem, setup=setup, objective=measured)
        return groups_remark(changed, Trail(best=truth, best_modelled=modelled))

    assert remarks(None) == ()
    (remark,) = remarks("f [MHz]")
    assert remark.values["column"] == "f [MHz]"
    assert "antennas, carriers or days" in remark_text(remark)


def field_and_noise(position: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Errors with a part that neighbours within 40 m share, and a slope [dB]."""
    distance = np.linalg.norm(position[:, None] - position, axis=2)
    root = np.linalg.cholesky(np.exp(-distance / 40) + 1e-9 * np.eye(len(position)))
    count = len(position)
    return 4 * root @ random.normal(size=count) + random.normal(0, 3, count) + 0.05 * position[:, 0]


def test_groups_of_devices_are_found_and_those_of_places_are_not():
    found, mistaken = [], 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        position = random.uniform(0, 200, (160, 2))
        ends = np.hstack([np.tile([0.0, 0.0, 20.0], (160, 1)), position, np.full((160, 1), 1.5)])
        errors, device = field_and_noise(position, random), random.choice(list("abcd"), 160)
        street = np.char.add(
            (position[:, 0] // 50).astype(int).astype(str), (position[:, 1] > 100).astype(str)
        )
        side = np.where(position[:, 0] > 100, "east", "west")
        places = {"street": street, "side": side}
        mistaken += bool(
            differing_groups(errors + 5.0 * (side == "east"), ends, {**places, "device": device})
        )
        differing = differing_groups(errors + 5.0 * (device == "c"), ends, {**places, "device": device})
        found += [each for each in differing if each.label == "c"]
    assert mistaken <= 2
    assert len(found) > 30
    standard = [(each.difference_db - 5.0) / each.error_db for each in found]
    assert abs(np.mean(standard)) < 0.7
    assert np.std(standard) < 1.6


def test_groups_without_a_difference_are_seldom_reported():
    reported = 0
    for seed in range(200):
        random = np.random.default_rng(seed)
        ends = np.hstack([np.zeros((60, 3)), random.uniform(0, 200, (60, 2)), np.full((60, 1), 1.5)])
        device = random.choice(list("ab"), 60)
        reported += bool(differing_groups(random.normal(0, 3, 60), ends, {"device": device}))
    assert reported <= 6


def test_transmitters_are_places_too():
    random = np.random.default_rng(3)
    mast = np.arange(200) % 2
    rx = np.column_stack([random.uniform(0, 100, (200, 2)), np.full(200, 1.5)])
    ends = np.hstack([np.where(mast[:, None] == 1, [[10.0, 0.0, 20.0]], [[0.0, 0.0, 20.0]]), rx])
    site = np.where(mast == 1, "north", "south")
    assert differing_groups(random.normal(size=200) + 5.0 * mast, ends, {"site": site}) == []
