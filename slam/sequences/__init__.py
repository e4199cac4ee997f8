"""Reading RGB-D sequences of many formats."""
