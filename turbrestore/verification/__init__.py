"""How far a restored image can be trusted: structure, halves of the clip, repetition, deviation of pixels."""
