"""Where the camera is in every frame, and the smooth path that it is steadied to."""
