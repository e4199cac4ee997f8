"""The map and masks on another machine: a connection, its two ends, and what goes over it."""
