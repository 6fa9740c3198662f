"""Analysis of clips: cuts, stuck pixels, repeated and blank frames, and the sharpness of frames."""
