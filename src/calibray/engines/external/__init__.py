"""External programs as engines: the files exchanged with them, and the calls that run them."""
