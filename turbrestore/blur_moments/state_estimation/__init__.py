"""Estimators of motion from moments and images: lifted and augmented systems, and observers."""
