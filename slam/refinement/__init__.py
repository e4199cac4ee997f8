"""Offline refinement: bundle adjustment of a finished run, optimisation of g2o files."""
