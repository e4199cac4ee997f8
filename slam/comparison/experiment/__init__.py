"""Experiments: files, options, data folders, results and their provenance."""
