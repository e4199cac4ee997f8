"""Kalman-filter tracks of movable instances between keyframes."""
