"""The two ways in which Calibray refuses: bad input, and an engine that failed while running."""


class InputError(ValueError):
    """Input that cannot be used.

    The message names the place (file, row, key), the value, the bound and the remedy. The command line prints it
    alone, without a traceback, and exits with 2.
    """


class EngineError(RuntimeError):
    """An engine that failed while running; whatever was computed before is kept. The command line exits with 1."""
