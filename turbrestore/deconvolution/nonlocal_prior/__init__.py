"""Nonlocal total variation: patches, weights, and the penalty."""
