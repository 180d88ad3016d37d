"""Space mapping: a cheap model corrected by few calls of an expensive engine."""
