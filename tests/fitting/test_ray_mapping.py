"""Ray mapping: an engine with other antennas and physics is understood from the powers of its rays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

import two_ray
from calibray.engines import Replay
from calibray.engines.rays.compile import RaySetting, compile_rays, powers, rays_of
from calibray.engines.rays.export import Export
from calibray.engines.rays.table import RayTable
from calibray.fitting import ray_fit
from calibray.fitting.problem import Problem
from calibray.fitting.ray_fit import understand
from calibray.fitting.ray_mapping import RayMap, map_rays
from calibray.fitting.ray_model import ANGLES, HALF_SPACE, Call, RayModel
from calibray.materials import Material
from calibray.paths import Paths
from calibray.study import Setup
from calibray.tracing.settings import Antenna

TRUTH = 7.7


@dataclass(frozen=True)
class Foreign:
    """An engine whose antennas and ground the study does not know; it answers with rays."""

    problem: Problem
    paths: Paths
    table: RayTable
    ripple: float = 0.0

    def __call__(self, candidate: np.ndarray) -> Export:
        return Export.of_table(self.rays(candidate), RaySetting.of(self.problem.setup))

    def rays(self, candidate: np.ndarray) -> RayTable:
        materials = self.problem.parameters.materials(candidate, self.paths.materials)
        power = powers(replace(self.paths, materials=materials))
        count = np.arange(len(power))
        return replace(self.table, power=power * 10 ** (self.ripple * np.sin(3 * candidate[0] + count)))


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Foreign:
    setup = Setup.open(
        two_ray.study(tmp_path_factory.mktemp("study"), objective={"combining": "power"}, antennas={}),
        two_ray.TwoRay,
    )
    paths = setup.trace()
    table = rays_of(paths)
    antennas = Antenna("tr38901", "H", (0.5, 0.2, 0.0)), Antenna("iso", "H")
    bare = compile_rays(
        replace(table, power=None), RaySetting(setup.scene, setup.radio.frequency, antennas, setup.links)
    )
    ground = Material(3.0, 0.02, HALF_SPACE)
    bare = replace(bare, materials={**bare.materials, "ground": ground})
    engine = Replay(bare, setup.parameters)
    measured = engine.path_loss(np.array([[TRUTH]]))[0]
    problem = Problem.of(setup, Replay(paths, setup.parameters))
    return Foreign(replace(problem, objective=replace(problem.objective, measured=measured)), bare, table)


@pytest.fixture(scope="module")
def mapped(foreign: Foreign) -> RayMap:
    return map_rays(foreign.problem, foreign)


def test_three_calls_find_the_truth_of_an_engine_that_differs(mapped: RayMap, foreign: Foreign) -> None:
    assert len(mapped.calls) == 3
    assert mapped.calls[-1].candidate[0] == pytest.approx(TRUTH, rel=1e-3)
    assert mapped.understood
    assert mapped.gap_db < 0.01
    assert mapped.changed == 0
    # Its replay stands for the engine elsewhere, too.
    loss = -10 * np.log10(np.bincount(foreign.paths.link, foreign.rays(np.array([4.4])).power))
    np.testing.assert_allclose(mapped.engine.path_loss(np.array([[4.4]]))[0], loss, atol=0.02)


def test_a_slab_is_found_among_its_resonances(foreign: Foreign) -> None:
    """The study assumes 1 m and 0.5 S/m, where no wave comes back through the slab."""
    paths = replace(
        foreign.paths, materials={**foreign.paths.materials, "ground": Material(3.0, 0.004, 0.437)}
    )
    calls = [
        Call(np.array([value]), replace(foreign, paths=paths)(np.array([value]))) for value in (4.0, 9.0)
    ]
    found = understand(foreign.problem.parameters, calls, known=False)
    constants = dict(found.model.described(found.values))
    assert found.misfit_db < 0.01
    assert constants["ground.thickness"] == pytest.approx(0.437, rel=1e-3)
    assert constants["ground.conductivity"] == pytest.approx(0.004, rel=0.05)


def test_values_that_no_ratio_shows_stay(foreign: Foreign) -> None:
    """Without polarization no power depends on a slant; a value that drifts would be where the next scan starts."""
    calls = [Call(np.array([value]), foreign(np.array([value]))) for value in (4.0, 9.0)]
    model = RayModel.of(foreign.problem.parameters, calls[-1].export.paths, False)
    slants = len(model.assumed) + np.array([0, ANGLES])
    start = model.start.copy()
    start[slants] = 0.3
    fit = ray_fit.Understanding(model, start, (False, False), np.inf)
    refined = ray_fit.refined(fit, ray_fit.ratios_of(calls), calls[-1], 12)
    np.testing.assert_array_equal(refined.values[slants], 0.3)
    assert not np.array_equal(refined.values, start)


def test_an_engine_of_other_physics_is_not_understood(foreign: Foreign) -> None:
    strange = map_rays(foreign.problem, replace(foreign, ripple=0.1), most_calls=3)
    assert not strange.understood
    assert strange.understanding.misfit_db > 0.2
    # It agrees with the engine at the best call nevertheless.
    last = strange.best
    np.testing.assert_allclose(
        strange.engine.path_loss(last.candidate[None])[0], last.export.path_loss_db, atol=1e-6
    )
