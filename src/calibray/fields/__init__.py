"""Fields along stored paths for any materials, in pure JAX; batched over candidates, and differentiable.

The gain of a path is a = (lambda / 4 pi) A E_rx^H J_K ... J_1 E_tx, with the spreading factor A, the antenna fields E
and one Jones matrix J for each interaction.

Path programs are evaluated in double precision by default, and in single precision on request. The functions of this
package run under their own JAX settings (`calibray.fields.jax_settings`). Importing the package does not change JAX's
settings.
"""

from calibray.fields.coefficient_tables import FINEST as FINEST
from calibray.fields.coefficient_tables import table_intervals as table_intervals
from calibray.fields.effects import DisplacementLoss as DisplacementLoss
from calibray.fields.effects import EffectBatch as EffectBatch
from calibray.fields.effects import Effects as Effects
from calibray.fields.effects import ExtraLoss as ExtraLoss
from calibray.fields.effects import RoughSurfaces as RoughSurfaces
from calibray.fields.evaluation import WITHOUT_TABLES as WITHOUT_TABLES
from calibray.fields.evaluation import path_gains as path_gains
from calibray.fields.evaluation import path_loss as path_loss
from calibray.fields.evaluation import path_losses as path_losses
from calibray.fields.evaluation import path_losses_and_slopes as path_losses_and_slopes
from calibray.fields.evaluation import (
    path_losses_and_slopes_with_effects as path_losses_and_slopes_with_effects,
)
from calibray.fields.evaluation import path_losses_with_effects as path_losses_with_effects
from calibray.fields.evaluation import path_powers as path_powers
from calibray.fields.evaluation import program_gains as program_gains
from calibray.fields.evaluation import program_path_loss as program_path_loss
from calibray.fields.jax_context import jax_settings as jax_settings
from calibray.fields.observables import Channel as Channel
from calibray.fields.observables import link_responses as link_responses
from calibray.fields.observables import link_responses_and_slopes as link_responses_and_slopes
from calibray.fields.program import GroupedProgram as GroupedProgram
from calibray.fields.program import Layout as Layout
from calibray.fields.program import layout as layout
from calibray.fields.propagation import Combining as Combining
from calibray.fields.propagation import path_loss_of_gains as path_loss_of_gains
