"""What is found in a clip before it is registered, and taken out of its frames.

The survey reads the clip once.  From it come the checks (cuts, blank and repeated frames, stuck pixels), light, levels,
patterns of the sensor, bars, overlays and moving objects.
"""
