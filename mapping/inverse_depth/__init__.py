"""Dense depth of keyframes: the six steps of the paper's Algorithm 1 on inverse depth."""
