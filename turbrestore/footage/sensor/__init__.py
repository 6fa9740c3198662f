"""What the sensor adds to every frame: dark frames and flat fields, stripes, offsets of its pixels."""
