"""Strength of the turbulence in a clip, and how far its restored image is to be believed."""
