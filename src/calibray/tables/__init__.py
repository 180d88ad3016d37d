"""Tables as data, and how they are written: as text, as HTML, as Markdown, or at a glance."""

from calibray.tables.table import Column, Table, numbers

__all__ = ["Column", "Table", "numbers"]
