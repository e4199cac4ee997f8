"""The camera's pose: tracking against the map, relocalisation, which frames become keyframes."""
