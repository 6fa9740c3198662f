"""What single frames can be wrong in: missing pixels, repeats, cuts."""
