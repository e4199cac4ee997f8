"""Worker processes (map, dense map, segmentation), their supervision, and the owner's side."""
