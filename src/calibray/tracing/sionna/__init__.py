"""Finding paths with Sionna RT; the only package that imports it."""

from calibray.tracing import llvm

llvm.prepare()  # before Dr.Jit loads an LLVM that would abort the process

from calibray.tracing.sionna.tracer import FLOATS, Links, Progress, Trace, Tracer, trace  # noqa: E402

__all__ = ["FLOATS", "Links", "Progress", "Trace", "Tracer", "trace"]
