"""Many restorations on one page: a picture, figures and, where a clip failed, the reason of each."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..core.arrays import FloatArray, from_unit
from ..display.preview import data_uri, encode_image, shrink
from ..io.output import atomic_write
from .comparison import environment
from .page import page_code

# Longest side of a picture, pixels, and its quality as WebP; both chosen.
_LONGEST, _QUALITY = 320, 90


@dataclass(frozen=True)
class ClipRow:
    """What became of one clip."""

    # Paths as they were given.
    input: str
    output: str
    state: str = "planned"  # planned, done or failed
    reason: str = ""  # why it failed, in one line
    # Frames that were read, and size of the result.
    frames: int = 0
    width: int = 0
    height: int = 0
    blur: float = 0.0  # width of the blur that was removed, pixels
    seconds: float = 0.0  # time of all stages
    checks: str = ""  # what a person has to check
    remarks: str = ""  # what was repaired, left out or unusual
    # Pictures of a frame and of the result, as data URIs.
    before: str = ""
    after: str = ""
    key: str = ""  # identifies input and settings; a clip with another key has to be restored again


def thumbnail_uri(image: FloatArray) -> str:
    """Make a small picture that a page can hold.

    ``image`` (H, W) or (H, W, 3).
    """
    return data_uri(encode_image(from_unit(shrink(image, _LONGEST), 8), "webp", _QUALITY), "webp")


def render_batch(rows: Sequence[ClipRow], folder: str = "") -> str:
    """Return the page of a batch as HTML."""
    template = environment().get_template("batch.html")
    counts = {state: sum(row.state == state for row in rows) for state in ("done", "failed", "planned")}
    links = {row.output: Path(row.output).name for row in rows}
    return template.render(
        page_code(("palette.css", "style.css")), rows=rows, counts=counts, links=links, folder=folder
    )


def write_batch_page(path: str | os.PathLike[str], rows: Sequence[ClipRow]) -> None:
    """Write the page of a batch beside its results, in place of an earlier one."""
    page = render_batch(rows, Path(path).absolute().parent.name)
    atomic_write(path, page.encode(errors="replace"), overwrite=True)
