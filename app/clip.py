"""A clip that was opened: what it is, what is unusual about it, and its frames to look at."""

from __future__ import annotations

import dataclasses
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from turbrestore.core.arrays import FloatArray
from turbrestore.footage.checks.content import clean_source
from turbrestore_cli.inputs import open_checked
from turbrestore_cli.inspection import describe_clip
from turbrestore_cli.options import Selection

if TYPE_CHECKING:
    import numpy as np

    from turbrestore.io.source import FrameSource

# Frames of the longest clip that is measured, and shown in a strip, when it is opened.
LOOKED_THROUGH = 600


@dataclass(frozen=True)
class Clip:
    """A clip that was looked through.

    Attributes
    ----------
    path : Path
    name : Path
        The path as a command names it.
    source : FrameSource
        All frames of the file, repaired; their numbers are those that ``--frames`` takes.
    facts : dict
        What ``turbrestore info`` says.
    """

    path: Path
    name: Path
    source: FrameSource
    facts: dict[str, object]
    _reading: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.source.shape[2], self.source.shape[1]

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was repaired or left out, or is unusual."""
        warnings = self.facts["warnings"]
        return tuple(warnings) if isinstance(warnings, list) else ()

    def frame(self, number: int) -> FloatArray:
        """Decode one frame."""
        with self._reading:
            return self.source.read(number, number + 1)[0]

    def quality(self) -> np.ndarray:
        """Quality, noise and brightness of every frame, (T, 3)."""
        from turbrestore.stacking.quality import measure_quality

        with self._reading:
            return measure_quality(self.source)


def open_clip(path: Path, name: Path) -> Clip:
    """Open a clip and look at every frame, as ``turbrestore info`` does.

    Parameters
    ----------
    path : Path
    name : Path
        How messages and commands name it.

    Returns
    -------
    Clip

    Raises
    ------
    TurbrestoreError
        The file is missing, damaged, too large or no clip.
    """
    whole, content = open_checked(path, Selection())
    cleaned = clean_source(whole, content)
    facts = describe_clip(cleaned, content)
    # Frames that are left out can be shown as well.
    shown = dataclasses.replace(
        whole, file_shape=cleaned.file_shape, pixels=cleaned.pixels, repair=cleaned.repair, bayer=cleaned.bayer
    )
    return Clip(path, name, shown, facts)
