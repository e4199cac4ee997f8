"""What is compared: experiment files, where their data is, and what a comparison holds."""
