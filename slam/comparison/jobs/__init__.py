"""Runs and renderings as jobs in processes of their own, and the figures of their results."""
