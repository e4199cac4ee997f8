"""The viewer: a live or a finished run in Rerun, in a recording, a browser or a window."""
