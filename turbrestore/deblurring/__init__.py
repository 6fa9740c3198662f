"""Blind deconvolution: estimate the blur, remove it, and check the result."""
