"""The surface of a live run while it grows: its frames, their files, and its process."""
