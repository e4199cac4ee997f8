"""A recorded sequence through the system: the run, its checkpoints, localisation in a map."""
