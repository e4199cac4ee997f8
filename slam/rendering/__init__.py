"""Rendered indoor sequences with exact poses, depth, instances and labels."""
