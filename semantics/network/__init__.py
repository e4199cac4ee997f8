"""Mask R-CNN with the MaskIoU head, in plain torch: every stage a file."""
