"""The process around a run: progress bars, stop signals, memory, machine, stage times."""
