"""What every engine offers, and what no engine accepts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np

from calibray.errors import InputError
from calibray.materials import Material
from calibray.parameters import Parameters

Progress = Callable[[int, int], None]


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

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        """Path loss of every link for candidates [n, d] in the fields' units; [n, L], [dB], +inf without a path."""
        ...


def check_candidates(candidates: np.ndarray, width: int) -> np.ndarray:
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
