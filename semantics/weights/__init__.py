"""Weight files: reading, recognising, checking and writing."""
