"""Research comparisons: sequences x methods x seeds, run, measured, tabulated, drawn."""
