"""How far a restored image is to be believed, pixel by pixel."""
