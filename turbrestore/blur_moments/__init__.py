"""Blur as a measurement: estimators for integrative image sensors, and the cues that the pipeline takes from them."""
