"""Published recordings and network weights: catalogue, download, unpacking, layout of the files."""
