"""What a run leaves on disk: stage files, checkpoints, the run folder and its record."""
