"""Batch optimisation: bundle adjustment without wrong loops and wrong observations."""
