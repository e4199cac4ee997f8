"""Keypoints and descriptors of a frame, their matching, and the index that finds similar frames."""
