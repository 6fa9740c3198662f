"""What a clip shows: cuts, stuck pixels, repeated or damaged frames, and which frames are sharpest."""
