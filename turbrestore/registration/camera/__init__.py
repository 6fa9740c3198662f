"""Motion of the camera: shifts, turns and zooms of whole frames."""
