"""The objects of a run: queried, and written as a scene graph."""
