"""Synthetic scenes and turbulent sequences."""
