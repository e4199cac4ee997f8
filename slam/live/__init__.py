"""The live loop: tracking in the caller's process, the map and segmentation in their own."""
