"""Materials, furniture, small objects and people that scenes are made of."""
