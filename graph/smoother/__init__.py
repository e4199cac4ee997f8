"""The incremental smoother (ISAM2): validation, removal, anchoring, repair, saved graphs."""
