"""Tables as data, and their rendering as text, HTML and Markdown."""

from calibray.tables.table import Column, Table, numbers

__all__ = ["Column", "Table", "numbers"]
