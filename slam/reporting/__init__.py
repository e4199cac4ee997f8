"""Web pages of runs and comparisons: one template, one style, one file without a network."""
