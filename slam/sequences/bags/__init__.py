"""Recordings of ROS as sequences."""
