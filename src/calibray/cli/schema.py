"""`calibray schema`: print the JSON schema of study files."""

from __future__ import annotations

import typer


def schema() -> None:
    """Print the JSON schema of study files, with which editors complete and check them."""
    from calibray.study.schema import schema_text

    typer.echo(schema_text(), nl=False)
