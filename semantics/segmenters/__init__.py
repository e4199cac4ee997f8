"""Segmenters: networks, cached masks, label images, remote ones; evaluation."""
