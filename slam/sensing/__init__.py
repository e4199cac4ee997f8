"""Measurements of other sensors: which of them become factors of which keyframes."""
