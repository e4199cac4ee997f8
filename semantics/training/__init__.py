"""Training of the network: data, losses, the loop."""
