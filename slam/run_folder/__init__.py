"""A run folder: its files, written while a run goes on and read back by `Run`."""
