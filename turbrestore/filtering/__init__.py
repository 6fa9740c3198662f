"""Alternating-estimation Kalman filter over image and flow state (paper 3, section 4)."""
