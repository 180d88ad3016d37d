"""Fields along stored paths, for any materials: pure JAX, batched over candidates, with derivatives.

A path's gain is (lambda / 4 pi) A E_rx^H J_K ... J_1 E_tx. Complex numbers are pairs of real arrays, a form that
compilers vectorize. Precision follows the program: float64 by default, as `jax_enable_x64` is switched on here.
"""

import jax

jax.config.update("jax_enable_x64", True)
# Programs run where they are called from: to hand a small one to another thread takes longer than to run it. Large ones
# share their work out to threads all the same.
jax.config.update("jax_cpu_enable_async_dispatch", False)

from calibray.fields.xla_cache import keep_compiled  # noqa: E402

keep_compiled()

from calibray.fields.combining import (  # noqa: E402
    COMBINING,
    band_quadrature,
    check_combining,
    decibel,
    link_power,
)
from calibray.fields.evaluation import (  # noqa: E402
    path_gains,
    path_loss,
    path_losses,
    path_losses_and_slopes,
    path_powers,
    program_path_loss,
)
from calibray.fields.program import GroupedProgram, Layout, layout, material_table  # noqa: E402
from calibray.fields.resolution import FINEST, table_intervals  # noqa: E402

__all__ = [
    "COMBINING",
    "FINEST",
    "GroupedProgram",
    "Layout",
    "band_quadrature",
    "check_combining",
    "decibel",
    "layout",
    "link_power",
    "material_table",
    "path_gains",
    "path_loss",
    "path_losses",
    "path_losses_and_slopes",
    "path_powers",
    "program_path_loss",
    "table_intervals",
]
