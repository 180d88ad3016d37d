"""Path tracing with Sionna RT, which only this package imports."""

from calibray.tracing import llvm

# This call precedes the imports below because they load Dr.Jit, which would abort the process with an unsuitable LLVM.
llvm.prepare()

from calibray.tracing.sionna.tracer import Trace, Tracer  # noqa: E402

__all__ = ["Trace", "Tracer"]
