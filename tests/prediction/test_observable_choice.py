"""The observable worth measuring against the closed form of one parameter and one link, by finite differences."""

from types import SimpleNamespace

import numpy as np
import pytest

import planted
from calibray.measurements.observables import KINDS, Statistic
from calibray.prediction.observables import CHOICES, ERROR_DB, RELATIVE_ERROR, worth_measuring

LINK = 3


def test_the_observable_with_the_largest_slope_over_its_error_is_chosen():
    engine, study = planted.engine(), SimpleNamespace(observables={})
    value = np.array([[planted.TRUTH[name] for name in engine.parameters.names]])
    known = 1e9 * np.eye(3)
    known[0, 0] = 4.0  # only the first parameter is uncertain
    (worth,) = worth_measuring(
        SimpleNamespace(study=study), engine, (value, np.ones((1, 3))), np.array([LINK]), known[None, None]
    )
    wanted, step = tuple(map(Statistic, CHOICES)), np.array([[1e-4, 0.0, 0.0]])
    now, above, below = engine.respond(np.vstack([value, value + step, value - step]), wanted).observed[
        :, :, LINK
    ]
    error = np.array([ERROR_DB if KINDS[kind] == "dB" else RELATIVE_ERROR for kind in CHOICES])
    error *= np.where(error == ERROR_DB, 1.0, now)
    slope = (above - below) / 2e-4 / error
    best = int(np.argmax(np.abs(slope)))
    assert worth.kind == CHOICES[best]
    assert worth.narrowed[0] == pytest.approx(1 / np.sqrt(1 + slope[best] ** 2 / 4.0), rel=1e-4)
    assert worth.narrowed[1:] == pytest.approx(1.0, abs=1e-6)
