"""External programs as engines: the files exchanged with a program, and the calls of the program."""
