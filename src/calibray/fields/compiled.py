"""Compilation of a program's functions: a large program is compiled to run fast, a small one to be compiled fast."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, Final

import jax

from calibray.fields.program import FormulaArguments, GroupedProgram

WIDE: Final = {"xla_cpu_prefer_vector_width": 512}
"""Compile for vectors of 512 bits. XLA prefers 256 even on processors with wider instructions; on others the option has
no effect. The numbers are the same."""

_QUICK: Final = WIDE | {"xla_cpu_use_fusion_emitters": False}
"""The same without XLA's emitters of fused loops. The numbers differ by rounding."""

SMALL: Final = 300
"""Largest number of coefficients of a small program. With 120, path loss and derivatives are compiled in 2.3 s instead
of 3.4 s, and a candidate takes up to 20 us longer; with 960, 135 us longer (`docs/measurements/speed.md`)."""


def compiled(
    function: Callable[..., Any] | None = None, *, static_argnums: int | tuple[int, ...] = ()
) -> Callable[..., Any]:
    """A compiled function, like `jax.jit`, whose first argument is a program or has one as `program`.

    Args:
        function: The function; None returns a decorator.
        static_argnums: Positions of arguments for whose every value it is compiled.
    """
    if function is None:
        return lambda function: compiled(function, static_argnums=static_argnums)
    to_run_fast = jax.jit(function, static_argnums=static_argnums, compiler_options=WIDE)
    compiled_fast = jax.jit(function, static_argnums=static_argnums, compiler_options=_QUICK)

    @wraps(function)
    def call(first: Any, *arguments: Any) -> Any:
        quick = is_small(getattr(first, "program", first)) and _xla_has_the_option()
        return (compiled_fast if quick else to_run_fast)(first, *arguments)

    return call


def is_small(program: GroupedProgram) -> bool:
    """Whether a program takes so little time to evaluate that the time of its compilation matters more."""
    source = program.coefficients
    return isinstance(source, FormulaArguments) and len(source.material) <= SMALL


@cache
def _xla_has_the_option() -> bool:
    """Whether this version of XLA knows the option; an unknown one is an error."""
    try:
        jax.jit(lambda: 0, compiler_options=_QUICK)()
    except jax.errors.JaxRuntimeError:
        return False
    return True
