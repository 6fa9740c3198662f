"""Blur of an image: point spread functions, and estimates of its width."""
