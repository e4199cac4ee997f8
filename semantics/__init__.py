"""Labels, instance masks, the segmentation network, class beliefs of landmarks and objects."""
