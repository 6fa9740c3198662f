"""Light that changes from frame to frame: exposure, rows, white balance, shadows."""
