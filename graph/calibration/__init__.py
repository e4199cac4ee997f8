"""Self-calibration: bundle adjustment with the camera's parameters and their covariance."""
