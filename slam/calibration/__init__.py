"""Self-calibration of the camera from a finished run."""
