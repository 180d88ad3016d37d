"""The command line: parse, call, print; one file a command."""

__all__ = ["main"]


def main() -> None:
    """Run the command line of this process and end it."""
    from calibray.cli.app import app

    app()
