"""The results of the stages in memory, so that a change of the deconvolution runs the deconvolution alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from turbrestore.core.arrays import FloatArray
from turbrestore.footage.levels import Levels

Result = TypeVar("Result")

# Image of the result that a store is asked for by this name.
_IMAGES: dict[str, Callable[[Any], FloatArray]] = {
    "centroid": lambda found: found.image,
    "filtered": lambda found: found.image,
    "mean": lambda found: found,
    "deblurred": lambda found: found.deconvolution.image,
}
_ALWAYS_ANEW = "deblurred"


class StageMemory:
    """A store of :func:`turbrestore.restore` that keeps all results but the last, and shows images as they are done.

    Parameters
    ----------
    show : callable, optional
        Called as ``show(name, image)``; may raise to end the run.

    Examples
    --------
    >>> memory = StageMemory()
    >>> memory.get("dynamics", lambda: 1), memory.get("dynamics", lambda: 2)
    (1, 1)
    """

    def __init__(self, show: Callable[[str, FloatArray], None] | None = None) -> None:
        self.show = show
        self._results: dict[str, Any] = {}
        self._levels = Levels()

    def set_levels(self, levels: Levels) -> None:
        """Take the levels of the stages: what is shown has those of the clip."""
        self._levels = levels

    def has(self, name: str) -> bool:
        """Tell whether a result of this name is in memory."""
        return name in self._results

    def get(self, name: str, compute: Callable[[], Result]) -> Result:
        """Return what was computed under this name, or compute it."""
        result = self._results[name] if name in self._results else compute()
        if name != _ALWAYS_ANEW:
            self._results[name] = result
        if self.show is not None and name in _IMAGES:
            self.show(name, self._levels.original(_IMAGES[name](result)))
        return result

    def filter_start(self) -> None:
        """Return None: an interrupted filter starts anew."""

    def checkpoint(self, state: object) -> None:
        """Discard the checkpoint."""
