"""Finding paths with Sionna RT; the only package that imports it."""

from calibray.tracing import llvm

# Before Dr.Jit loads an LLVM that would abort the process.
llvm.prepare()

from calibray.tracing.sionna.stored import Trace  # noqa: E402
from calibray.tracing.sionna.tracer import FLOATS, Tracer  # noqa: E402

__all__ = ["FLOATS", "Trace", "Tracer"]
