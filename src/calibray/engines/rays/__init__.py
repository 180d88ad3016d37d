"""Ray tables: the paths of any engine, converted to a path program or written from one."""
