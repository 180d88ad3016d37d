"""Leverage against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from calibray.calibration.link_diagnostics import leverage


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
