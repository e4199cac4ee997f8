"""Training of the network: data, targets, losses, the loop, transfer to other labels."""
