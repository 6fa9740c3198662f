"""The widget that restores a layer: the result, its uncertainty and the motion become layers of their own."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import DataError, TurbrestoreError
from turbrestore.footage.checks.content import check_content, clean_source
from turbrestore.footage.frame_selection import Share
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames
from turbrestore.pipeline import restore
from turbrestore.results import Restoration
from turbrestore.settings import RestoreParams

from .reader import PATH, LayerData

if TYPE_CHECKING:
    import napari
    import napari.layers
    import napari.qt.threading
    import napari.types

# Arrows along the longer side of a frame.
_ARROWS = 40


# The window resolves annotations by importing the first part of their names.
def restore_layer(
    clip: napari.layers.Image,
    remove_blur: bool = True,
    keep_best: Annotated[float, {"min": 0.05, "max": 1.0, "step": 0.05}] = 1.0,
) -> napari.qt.threading.FunctionWorker[list[napari.types.LayerDataTuple]]:
    """Restore the clip of a layer in another thread.

    Parameters
    ----------
    clip : Image
        Layer of frames.
    remove_blur : bool
        Deblur the fused image by the blur that is measured.
    keep_best : float
        Share of the frames, the sharpest ones, from which the image is made.

    Returns
    -------
    FunctionWorker
        Yields the layers when it is done; an error is shown as one line.
    """
    from napari.qt.threading import create_worker
    from napari.utils.notifications import show_error
    from qtpy.QtCore import QTimer

    if clip is None:
        raise DataError("restore: expected a layer with a clip, found none; open one first")
    params = RestoreParams(keep_best=Share(keep_best), until="deconvolve" if remove_blur else "filter")
    source, name, place = clip_of(clip), clip.name, tuple(float(value) for value in clip.translate[-2:])

    def work() -> list[LayerData]:
        try:
            return layers_of(restore(clean_source(source, check_content(source)), params), name, place)
        except TurbrestoreError as error:
            show_error(str(error))
            return []

    worker = create_worker(work, _start_thread=False)
    # The window asks for the layers only after this function has returned.
    QTimer.singleShot(0, worker.start)
    return worker


def clip_of(layer: napari.layers.Image) -> FrameSource:
    """Return the frames of a layer: those of the file that it shows, or its array.

    Raises
    ------
    DataError
        The layer has no time axis, or values that are no intensities.
    """
    path = layer.metadata.get(PATH)
    if path is not None:
        return open_frames(path)
    axes = layer.data.ndim - bool(layer.rgb)
    if axes != 3:
        raise DataError(f"{layer.name}: expected frames of shape (T, H, W) or (T, H, W, 3), found {layer.data.shape}")
    frames = FrameSource.from_array(layer.data, layer.name)
    return dataclasses.replace(frames, path=None)


def layers_of(restoration: Restoration, name: str, place: tuple[float, ...] = (0.0, 0.0)) -> list[LayerData]:
    """Return the result, its uncertainty, and the motion of the training frames as layers."""
    x, y = restoration.crop[:2]
    decisions = {decision.subject: decision.choice for decision in restoration.decisions}
    at = {"translate": (place[0] + y, place[1] + x)}
    shown = {"contrast_limits": (0.0, 1.0), "rgb": restoration.image.ndim == 3, "metadata": decisions, **at}
    layers: list[LayerData] = []
    if restoration.uncertainty is not None:
        finite = restoration.uncertainty[np.isfinite(restoration.uncertainty)]
        limits = (0.0, float(finite.max()) if finite.size else 1.0)
        hidden = {"name": f"{name}, uncertainty", "colormap": "viridis", "visible": False, "contrast_limits": limits}
        layers.append((restoration.uncertainty, hidden | at, "image"))
    arrows = {"name": f"{name}, motion", "edge_width": 0.5, "visible": False, "translate": (0.0, *place)}
    layers.append((vectors(restoration.centroid.flows), arrows, "vectors"))
    layers.append((restoration.image, {"name": f"{name}, restored", **shown}, "image"))
    return layers


def vectors(flows: FloatArray) -> NDArray[np.float32]:
    """Thin flows out to arrows of napari: where each begins, (t, y, x), and how far it goes.

    Parameters
    ----------
    flows : ndarray, float32, shape (T, H, W, 2)
        Displacements (dx, dy), pixels.

    Returns
    -------
    ndarray, float32, shape (N, 2, 3)

    Examples
    --------
    >>> vectors(np.full((1, 16, 16, 2), 0.5, np.float32))[0].tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5]]
    """
    count, height, width = flows.shape[:3]
    step = max(1, round(max(height, width) / _ARROWS))
    begins = np.stack(np.meshgrid(range(count), range(0, height, step), range(0, width, step), indexing="ij"), axis=-1)
    along = np.concatenate([np.zeros((*begins.shape[:3], 1)), flows[:, ::step, ::step, ::-1]], axis=-1)
    return np.stack([begins, along], axis=3).reshape(-1, 2, 3).astype(np.float32)
