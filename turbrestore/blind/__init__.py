"""Blind deconvolution: estimate the blur, map how it varies, remove it, and check the result."""
