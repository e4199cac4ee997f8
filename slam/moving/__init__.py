"""Moving things: found by depth and by masks, kept out of tracking, taken out of the map."""
