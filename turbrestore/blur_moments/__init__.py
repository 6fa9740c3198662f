"""Blur as a measurement: estimators of motion for integrative image sensors (papers 1 and 2)."""
