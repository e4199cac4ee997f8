"""Where things are: geometry, cameras, trajectories and the factor graph."""
