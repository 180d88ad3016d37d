"""All compilations of a program's functions give the same numbers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import synthetic
from calibray.fields import evaluation, jax_context, layout, path_losses_and_slopes
from calibray.fields import program as programs
from calibray.fields.propagation import POWER
from calibray.paths import Kind

SEQUENCES = [(Kind.DIFFUSE,), (Kind.REFRACTION, Kind.DIFFUSE)]
OPTIMIZED = {
    "xla_backend_optimization_level": 3, "xla_llvm_disable_expensive_passes": False,
    "xla_cpu_use_fusion_emitters": True,
}  # fmt: skip
"""The options of a user's run; the tests of this room are compiled without optimization (`tests/conftest.py`)."""


def test_a_small_program_has_the_numbers_of_a_large_one(monkeypatch: pytest.MonkeyPatch) -> None:
    paths = synthetic.program(SEQUENCES[1:] * 8, seed=8)
    program, table = layout(paths, phases=False).program, paths.material_table()[None]
    of_tests = path_losses_and_slopes(program, table, (0,))
    monkeypatch.setattr(jax_context, "WIDE", jax_context.WIDE | OPTIMIZED)
    monkeypatch.setattr(jax_context, "_QUICK", OPTIMIZED | jax_context._QUICK)
    function = jax_context.compiled(evaluation._slopes_by_formula.__wrapped__, static_argnums=3)
    assert program.is_small
    small = function(program, table, 1, (0,), POWER)
    monkeypatch.setattr(programs, "SMALL", 0)
    assert not program.is_small
    large = function(program, table, 1, (0,), POWER)
    for answers in zip(small, large, of_tests[:2], strict=True):
        for other in answers[1:]:
            np.testing.assert_allclose(answers[0], other, rtol=1e-11, atol=1e-11 * np.abs(other).max())
    assert np.abs(large[1]).max() > 0.1
    # Otherwise the options would have had no effect.
    assert any((small[1] != other[1]).any() for other in (large, of_tests))


def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    known = jax_context._xla_has_the_option.__wrapped__
    assert known()
    monkeypatch.setattr(jax_context, "_QUICK", {"xla_cpu_no_such_option": True})
    assert not known()


def test_only_small_programs_are_compiled_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    program = layout(synthetic.program(SEQUENCES, seed=8), phases=False).program
    assert jax_context._xla_has_the_option()
    monkeypatch.setattr(jax_context, "_QUICK", {"xla_cpu_no_such_option": True})
    function = jax_context.compiled(lambda program: jnp.zeros(()))
    with pytest.raises(jax.errors.JaxRuntimeError, match="no_such_option"):
        function(program)
    monkeypatch.setattr(programs, "SMALL", 0)
    assert function(program) == 0
