"""turbrestore: one sharp image from a video seen through atmospheric turbulence.

The public names are listed in ``__init__.pyi``; each is loaded when it is first used, so that
importing the package costs nothing.

Examples
--------
>>> import turbrestore
>>> turbrestore.RestoreParams().until
'deconvolve'
"""

import lazy_loader

__version__ = "0.4.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
