"""The scenes, one module each (loaded by its name), and the generator of random rooms."""
