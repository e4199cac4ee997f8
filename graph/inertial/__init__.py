"""Inertial measurements in the graph: velocities, biases, gravity, and the factors between them."""
