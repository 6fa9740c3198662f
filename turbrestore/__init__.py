"""turbrestore: one sharp image from a video seen through atmospheric turbulence."""

__version__ = "0.1.0"
