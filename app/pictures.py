"""Images of one tab, encoded for the browser and served at addresses of their own."""

from __future__ import annotations

from itertools import count

from turbrestore.core.arrays import FloatArray
from turbrestore.display.preview import encode_image
from turbrestore.report.pictures import to_levels

# Longest side that the browser gets, pixels.
LONGEST = 4096
# So many are kept of each kind: what is on the page, and what it may still ask for.
_KEPT = 16


class Pictures:
    """Encoded images, the newest ones of each kind.

    Parameters
    ----------
    address : str
        Beginning of their addresses, which are relative to that of the page.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._files: dict[str, bytes] = {}
        self._numbers = count(1)

    def put(self, image: FloatArray, shown: tuple[float, float] = (0.0, 1.0), kind: str = "stage") -> str:
        """Encode an image, with the intensities that are black and white, and return its address."""
        name = f"{kind}{next(self._numbers)}.png"
        self._files[name] = encode_image(to_levels(image, *shown, LONGEST))
        for old in [each for each in tuple(self._files) if each.startswith(kind)][:-_KEPT]:
            self._files.pop(old, None)
        return f"{self._address}/{name}"

    def get(self, name: str) -> bytes | None:
        """Return the file of a name; None if there is none."""
        return self._files.get(name)

    def clear(self) -> None:
        """Discard all."""
        self._files.clear()
