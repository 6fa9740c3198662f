"""For people who stack: registered frames, several clips in one geometry, finer grids, and discs that turn."""
