"""The owner of map and graph: keyframes in, landmarks, factors, pruning, joined segments."""
