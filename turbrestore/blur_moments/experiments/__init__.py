"""The simulated experiments of papers 1 and 2, behind the command ``turbrestore moments``."""
