"""A restoration as one HTML file."""
