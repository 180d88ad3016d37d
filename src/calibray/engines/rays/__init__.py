"""Ray tables: the paths of any engine, read into a path program or written from a path program."""
