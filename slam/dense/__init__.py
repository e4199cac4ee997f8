"""Dense mapping of a run: input, fusion of keyframes, folder of submaps, products."""
