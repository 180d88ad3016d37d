"""Tables as data, and their rendering as text and HTML."""

from calibray.tables.table import Column, Table, numbers

__all__ = ["Column", "Table", "numbers"]
