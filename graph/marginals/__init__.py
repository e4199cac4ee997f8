"""Marginal covariances, and relative poses that replace marginalised landmarks."""
