"""Depth cameras that are plugged in, each by its own library."""
