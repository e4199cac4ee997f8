"""Instances of an image: masks, COCO files, reading images, drawing."""
