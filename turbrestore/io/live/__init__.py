"""Frames that come one by one, and only once."""
