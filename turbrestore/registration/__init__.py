"""Optical flow from one reference to every frame, warping, and the centroid that the flow refers to."""
