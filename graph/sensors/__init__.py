"""Sensors beside the camera: their measurements, and the relative poses that they become."""
