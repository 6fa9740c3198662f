"""What is found in a clip before it is registered, and taken out of its frames.

The survey reads the clip once.  From it come the checks (cuts, blank and repeated frames, stuck pixels), light, levels,
patterns of the sensor, bars, overlays and moving objects.  What is taken out of the frames is a correction: one more is
one more function of a survey, and one more line in the list of :mod:`turbrestore.preparation`.
"""
