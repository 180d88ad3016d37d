"""Fields along stored paths, for any materials: pure JAX, batched over candidates, with derivatives.

The gain of a path is a = (lambda / 4 pi) A E_rx^H J_K ... J_1 E_tx, with amplitude spreading A, antenna fields E and
one Jones matrix J for each interaction.

Programs are in double precision by default, and in single precision on request. Functions compute under their own JAX
settings (`calibray.fields.jax_settings`); importing the package does not change JAX's settings.
"""

from calibray.fields.coefficient_tables import FINEST, table_intervals
from calibray.fields.effects import DisplacementLoss, Effects, ExtraLoss, RoughSurfaces
from calibray.fields.evaluation import (
    path_gains,
    path_loss,
    path_losses,
    path_losses_and_slopes,
    path_powers,
    program_gains,
    program_path_loss,
)
from calibray.fields.jax_context import jax_settings
from calibray.fields.program import GroupedProgram, Layout, layout

__all__ = [
    "FINEST",
    "DisplacementLoss",
    "Effects",
    "ExtraLoss",
    "GroupedProgram",
    "Layout",
    "RoughSurfaces",
    "jax_settings",
    "layout",
    "path_gains",
    "path_loss",
    "path_losses",
    "path_losses_and_slopes",
    "path_powers",
    "program_gains",
    "program_path_loss",
    "table_intervals",
]
