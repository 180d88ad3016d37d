"""Ray tables: the paths of any engine, read into a path program and written from one."""
