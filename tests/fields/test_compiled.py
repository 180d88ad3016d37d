"""Both compilations of a program's functions give the same numbers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import synthetic
from calibray.fields import compiled, layout, path_losses_and_slopes
from calibray.paths import Kind

SEQUENCES = [(Kind.DIFFUSE,), (Kind.REFRACTION, Kind.DIFFUSE)]


def test_a_small_program_has_the_numbers_of_a_large_one(monkeypatch: pytest.MonkeyPatch) -> None:
    paths = synthetic.program(SEQUENCES * 4, seed=8)
    program, table = layout(paths, phases=False).program, paths.material_table()[None]
    assert compiled.is_small(program)
    small = path_losses_and_slopes(program, table, (0, 4))
    monkeypatch.setattr(compiled, "SMALL", 0)
    assert not compiled.is_small(program)
    large = path_losses_and_slopes(program, table, (0, 4))
    for one, other in zip(small[:2], large[:2], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11 * np.abs(other).max())
    assert np.abs(large[1]).max() > 0.1


def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    known = compiled._xla_has_the_option.__wrapped__
    assert known()
    monkeypatch.setattr(compiled, "_QUICK", {"xla_cpu_no_such_option": True})
    assert not known()


def test_only_small_programs_are_compiled_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    program = layout(synthetic.program(SEQUENCES, seed=8), phases=False).program
    assert compiled._xla_has_the_option()
    monkeypatch.setattr(compiled, "_QUICK", {"xla_cpu_no_such_option": True})
    function = compiled.compiled(lambda program: jnp.zeros(()))
    with pytest.raises(jax.errors.JaxRuntimeError, match="no_such_option"):
        function(program)
    monkeypatch.setattr(compiled, "SMALL", 0)
    assert function(program) == 0
