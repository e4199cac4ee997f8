"""A run whose tracking, map and masks have a process each, and which repeats byte for byte."""
