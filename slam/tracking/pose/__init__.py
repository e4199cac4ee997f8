"""One frame's pose from its matches: optimisation, rolling shutter, new landmarks that move."""
