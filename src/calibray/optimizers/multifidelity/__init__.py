"""Space mapping: a cheap model corrected by a few calls of an expensive engine."""
