"""Shared by every other folder: checks of arrays, errors, decisions and the noise of an image."""
