"""Finding paths with Sionna RT; the only package that imports it."""

from calibray import llvm

llvm.select()  # before Dr.Jit loads one that would abort the process

from calibray.tracing.tracer import FLOATS, Links, Progress, Trace, Tracer, trace  # noqa: E402

__all__ = ["FLOATS", "Links", "Progress", "Trace", "Tracer", "trace"]
