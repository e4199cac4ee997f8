"""What surfaces look like: inverse-depth maps, fusion, submaps."""
