"""Figures and previews of results: arrays in, pictures out."""
