"""The command line: parse, call, print."""

from calibray.cli.commands import main

__all__ = ["main"]
