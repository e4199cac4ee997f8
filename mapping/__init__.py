"""Dense surfaces: inverse-depth maps of keyframes, their fusion, and what is made of them."""
