"""Path tracing with Sionna RT, which only this package imports."""

from calibray.tracing import llvm

# This call precedes the imports below, which load Dr.Jit; with an unsuitable LLVM, Dr.Jit would abort the process.
llvm.prepare()

from calibray.tracing.sionna.tracer import Trace, Tracer  # noqa: E402

__all__ = ["Trace", "Tracer"]
