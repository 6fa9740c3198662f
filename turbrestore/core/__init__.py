"""What every other folder shares: arrays, errors, decisions and the noise of an image."""
