"""Pose graphs offline: Levenberg-Marquardt, dogleg, and robust optimisation by GNC."""
