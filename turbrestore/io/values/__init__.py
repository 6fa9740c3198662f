"""How the numbers in files become intensities: counts, mosaics, raw files, pixel formats, coded light."""
