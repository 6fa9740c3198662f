"""Figures and previews of results, made from plain arrays."""
