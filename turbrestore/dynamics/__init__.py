"""Dynamic texture of the flow: identification, prediction and simulation of a linear system (paper 3, section 3)."""
