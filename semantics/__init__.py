"""What things are: labels, instances and the network that finds them."""
