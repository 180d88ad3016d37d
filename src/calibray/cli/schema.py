"""`calibray schema`: print the JSON schema of study files."""

from __future__ import annotations

from calibray.cli.console import echo


def schema() -> None:
    """Print the JSON schema of study files, with which editors complete and check them."""
    from calibray.study.schema import schema_text

    echo(schema_text(), nl=False)
