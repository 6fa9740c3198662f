"""Standard deviation of every pixel of a restored image."""
