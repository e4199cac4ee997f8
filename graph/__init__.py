"""Geometry, cameras, trajectories and their errors, factor graphs, self-calibration."""
