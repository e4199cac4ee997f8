"""Labels and objects of the map, from the masks of keyframes."""
