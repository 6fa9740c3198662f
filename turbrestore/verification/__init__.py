"""How far a restored image is to be believed: structure, halves of the clip, repetition, deviation of pixels."""
