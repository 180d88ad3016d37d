"""External programs as engines: the files exchanged with them, and how they are run."""
