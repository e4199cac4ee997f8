"""Loops: recognising places, verifying candidates, closing and refuting loops."""
