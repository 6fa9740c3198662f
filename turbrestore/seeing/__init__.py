"""Strength of the turbulence in a clip."""
