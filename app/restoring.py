"""One restoration as the page orders it: what of the clip, by which settings, and what came of it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from turbrestore.core.arrays import FloatArray
from turbrestore.settings import Preset, RestoreParams
from turbrestore_cli.inputs import open_input
from turbrestore_cli.options import Machine, Selection

from .stage_memory import StageMemory

if TYPE_CHECKING:
    from turbrestore.io.source import FrameSource, Roi
    from turbrestore.results import Restoration

    from .job import Job

# Of a preview: frames, and pixels a side.
PREVIEW_FRAMES, PREVIEW_SIDE = 24, 160


@dataclass(frozen=True)
class Order:
    """What to restore, and how.

    Parameters
    ----------
    path : Path
    selection : Selection
        Range of frames and region.
    params : RestoreParams
    preset : str
        Name of the preset that they started from.
    """

    path: Path
    selection: Selection = field(default_factory=Selection)
    params: RestoreParams = field(default_factory=RestoreParams)
    preset: Preset = "standard"

    def shares_filter_with(self, other: Order) -> bool:
        """Tell whether two orders differ in the deconvolution alone."""
        usual, own, others = RestoreParams(), self.params, other.params
        own, others = (
            dataclasses.replace(params, deconvolution=usual.deconvolution, guards=usual.guards, border=usual.border)
            for params in (own, others)
        )
        return (self.path, self.selection, own) == (other.path, other.selection, others)


@dataclass(frozen=True, eq=False)
class Restored:
    """A restoration, what was ordered, and what may be used again.

    Attributes
    ----------
    order : Order
    restoration : Restoration
    source : FrameSource
        What was read.
    frame : ndarray
        Its middle frame.
    memory : StageMemory
        Results of the stages up to the filter.
    """

    order: Order
    restoration: Restoration
    source: FrameSource
    frame: FloatArray
    memory: StageMemory

    @property
    def frame_number(self) -> int:
        """Number of the frame in the file."""
        return self.source.numbers[len(self.source) // 2]


def restore_order(order: Order, job: Job[object], earlier: Restored | None = None) -> Restored:
    """Run the chain as ``turbrestore restore`` does.

    Parameters
    ----------
    order : Order
    job : Job
        Hears of progress, decisions and images.
    earlier : Restored, optional
        Its stages up to the filter are used again where the order differs in the deconvolution alone.

    Returns
    -------
    Restored
    """
    from turbrestore.pipeline import restore

    if earlier is not None and not order.shares_filter_with(earlier.order):
        earlier = None
    source = open_input(order.path, order.selection, quiet=True) if earlier is None else earlier.source
    memory = StageMemory() if earlier is None else earlier.memory
    middle = len(source) // 2
    frame = source.read(middle, middle + 1)[0] if earlier is None else earlier.frame
    job.show("frame", frame)
    memory.show = job.show
    restoration = restore(source, order.params, Machine().runtime(), memory, job.progress, job.decided)
    memory.show = None
    job.message = f"Verdict: {restoration.verdict}."
    return Restored(order, restoration, source, frame, memory)


def preview_order(order: Order, shape: tuple[int, ...]) -> Order:
    """Reduce an order to a small part of the region and to few frames, so that it takes seconds.

    Where an object is followed or turned, which may be anywhere in the region, the region stays as it is.  The geometry
    is the clip's own, because a reference has the size of the whole.

    Parameters
    ----------
    order : Order
    shape : tuple of int
        (T, H, W) of the whole clip.

    Returns
    -------
    Order

    Examples
    --------
    >>> preview_order(Order(Path("a.mkv"), Selection(frames="8:90")), (100, 480, 640)).selection.frames
    '8:32'
    """
    start, stop, step = order.selection.frame_range() or (0, None, None)
    first, every = start or 0, step or 1
    last = min(shape[0] if stop is None else stop, first + PREVIEW_FRAMES * every)
    frames = f"{first}:{last}" if step is None else f"{first}:{last}:{step}"
    order = dataclasses.replace(order, params=dataclasses.replace(order.params, reference=None))
    if order.selection.crop_to_object or order.selection.derotate is not None:
        return dataclasses.replace(order, selection=dataclasses.replace(order.selection, frames=frames))
    x, y, width, height = order.selection.region() or (0, 0, shape[2], shape[1])
    w, h = min(width, PREVIEW_SIDE), min(height, PREVIEW_SIDE)
    # The mosaic of a raw clip repeats every two pixels.
    region: Roi = (x + (width - w) // 4 * 2, y + (height - h) // 4 * 2, w, h)
    selection = dataclasses.replace(order.selection, frames=frames, roi=",".join(map(str, region)))
    return dataclasses.replace(order, selection=selection)
