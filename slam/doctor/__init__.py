"""What is installed, which cameras are there, and how fast this machine is."""
