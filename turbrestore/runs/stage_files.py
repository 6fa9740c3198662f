"""Stage results on disk: one ``.npz`` file each, arrays plus a JSON header, never a pickle.

The header names the kind of result and the version of this layout, and holds every field that is not an array.  A run
keeps results as its stages made them, so that it continues with the same bits; where the frames were stretched, the
header says how, and whoever reads a file gets the levels of the clip.
Flow stacks by themselves are plain ``.npy`` files, which anything reads and which can be memory-mapped.
"""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..blur.estimation import BlurEstimate
from ..blur.posterior import BlurPosterior
from ..core.arrays import FloatArray, check_flow
from ..core.errors import DataError, InputNotFoundError
from ..core.noise_spectrum import NoiseSpectrum
from ..deconvolution.deconvolve import Deconvolution
from ..dynamics.flow_model import FlowDynamics
from ..filtering.alternating import Filtered
from ..footage.levels import Levels
from ..io.images.image_files import read_image
from ..io.limits import check_input
from ..io.npy import map_npy, read_npz, write_npz
from ..io.output import atomic_output, check_output
from ..registration.centroid import Centroid
from ..registration.recentring import recentre
from ..results import at_levels_of_clip
from .stage_fields import check_fields
from .typed_records import convert_to

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SCHEMA = 1
KINDS: dict[str, type[DataclassInstance]] = {
    "centroid": Centroid,
    "dynamics": FlowDynamics,
    "filtered": Filtered,
    "blur": BlurEstimate,
    "noise": NoiseSpectrum,
    "posterior": BlurPosterior,
    "deconvolution": Deconvolution,
}
_HEADER = "header"
# Frames are never stretched as much; chosen.
_MOST_GAIN = 1e30

Result = TypeVar("Result", bound="DataclassInstance")


def save_artifact(path: str | os.PathLike[str], result: DataclassInstance, overwrite: bool = False) -> None:
    """Write a stage result.

    Parameters
    ----------
    path : path
        Must end in ``.npz``.
    result : Centroid, FlowDynamics, Filtered, Deconvolution, BlurEstimate, NoiseSpectrum or BlurPosterior
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    ConfigurationError
        Another suffix.
    OutputError
        The file exists, or its folder does not.
    StorageError
        Writing failed; nothing is left behind.

    Examples
    --------
    >>> import numpy as np, tempfile
    >>> from turbrestore.dynamics.dynamic_texture import identify
    >>> from turbrestore.dynamics.flow_model import FlowDynamics
    >>> dynamics = identify(np.random.default_rng(0).normal(size=(5, 4, 4, 2)).astype(np.float32))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_artifact(folder + "/dynamics.npz", dynamics)
    ...     again = load_artifact(folder + "/dynamics.npz", FlowDynamics)
    >>> bool((again.A == dynamics.A).all())
    True
    """
    check_output(Path(path), overwrite=overwrite, suffixes=(".npz",))
    save_stage(Path(path), result, Levels(), overwrite)


def save_stage(target: Path, result: DataclassInstance, levels: Levels, overwrite: bool = True) -> None:
    """Write a stage result that has the levels of the stages."""
    kind = _kind_of(type(result))
    values = {item.name: getattr(result, item.name) for item in dataclasses.fields(result)}
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    others = {name: value for name, value in values.items() if name not in arrays}
    stretched = {"levels": [levels.low, levels.gain]} if levels.changed else {}
    header = json.dumps({"kind": kind, "schema": SCHEMA, "fields": others, **stretched})
    with atomic_output(target, overwrite) as temporary, temporary.open("wb") as stream:
        write_npz(stream, {_HEADER: np.array(header), **arrays})


def load_artifact(path: str | os.PathLike[str], kind: type[Result], scratch: Path | None = None) -> Result:
    """Read a stage result back, at the levels of the clip.

    Parameters
    ----------
    path : path
        File written by :func:`save_artifact`.
    kind : type
        Class that is expected.
    scratch : Path, optional
        Folder of a file that holds what is large; by default that is in memory.

    Returns
    -------
    instance of ``kind``

    Raises
    ------
    InputNotFoundError
        There is no such file.
    DataError
        The file is damaged, of another kind, of another version of the layout, or holds what no stage makes.

    Examples
    --------
    >>> import numpy as np, tempfile
    >>> from turbrestore.registration.centroid import Centroid, find_centroid
    >>> found = find_centroid(np.random.default_rng(0).uniform(size=(3, 32, 32)).astype(np.float32))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_artifact(folder + "/centroid.npz", found)
    ...     again = load_artifact(folder + "/centroid.npz", Centroid)
    >>> again.flows.shape, bool((again.image == found.image).all())
    ((3, 32, 32, 2), True)
    """
    return at_levels_of_clip(*_read_kind(Path(path), kind, scratch))


def load_stage(path: Path, kind: type[Result], scratch: Path | None = None) -> Result:
    """Read a stage result back as its stage made it."""
    return _read_kind(path, kind, scratch)[0]


def load_stage_image(path: str | os.PathLike[str]) -> FloatArray:
    """Read an image file, or the image of a stage file that has one.

    Returns (H, W) or (H, W, 3).
    """
    source = Path(path)
    if source.suffix.lower() != ".npz":
        return read_image(source).image
    return _image_of(source, at_levels_of_clip(*_read(source)))


def load_guide(path: str | os.PathLike[str], image: str | os.PathLike[str]) -> FloatArray:
    """Read the image of a stage file that guides the deconvolution of another one, in the geometry of the latter.

    A filtered image lies at the mean geometry of all frames, the centroid at that of the training frames. So the
    centroid is moved as the filtered image was, as :func:`turbrestore.restore` does.
    Returns (H, W) or (H, W, 3).
    """
    result, guided = (at_levels_of_clip(*_read(Path(name))) for name in (path, image))
    guide = _image_of(Path(path), result)
    if not (isinstance(result, Centroid) and isinstance(guided, Filtered)):
        return guide
    if guide.shape[:2] != guided.mean_flow.shape[:2]:
        raise DataError(f"{path}: expected the size of {image}, {guided.mean_flow.shape[:2]}, found {guide.shape[:2]}")
    return recentre(guide, guided.mean_flow)


def save_flows(path: str | os.PathLike[str], flows: ArrayLike, overwrite: bool = False) -> None:
    """Write flows as a ``.npy`` file.

    ``flows`` (T, H, W, 2).
    """
    target = Path(path)
    check_output(target, overwrite=overwrite, suffixes=(".npy",))
    with atomic_output(target, overwrite) as temporary, temporary.open("wb") as stream:
        np.save(stream, check_flow(flows, "flows"), allow_pickle=False)


def load_flows(path: str | os.PathLike[str]) -> FloatArray:
    """Read flows from a ``.npy`` file, or those of a centroid stage file.

    Returns (T, H, W, 2).
    """
    source = Path(path)
    if source.suffix.lower() == ".npz":
        return load_artifact(source, Centroid).flows
    if not source.is_file():
        raise InputNotFoundError(f"{source}: no such file")
    try:
        flows = map_npy(source)
    except DataError as error:
        raise DataError(f"{source}: expected flows in a .npy file, found something else") from error
    if flows.ndim != 4:
        raise DataError(f"{source}: expected flows of shape (T, H, W, 2), found {flows.shape}")
    return check_flow(flows, str(source))


def _read_kind(source: Path, kind: type[Result], scratch: Path | None) -> tuple[Result, Levels]:
    """Read the result in a stage file of one kind, and its levels."""
    result, levels = _read(source, scratch)
    if not isinstance(result, kind):
        found = _kind_of(type(result))
        raise DataError(f"{source}: expected a {_kind_of(kind)} stage file, found a {found} stage file")
    return result, levels


def _read(source: Path, scratch: Path | None = None) -> tuple[DataclassInstance, Levels]:
    """Read the result in a stage file, and its levels."""
    if source.is_dir() or not source.exists():
        raise InputNotFoundError(f"{source}: no such file")
    check_input(source)
    try:
        arrays = read_npz(source, scratch=scratch)
        header: dict[str, Any] = json.loads(str(arrays.pop(_HEADER)))
        kind, schema, fields = header["kind"], header["schema"], {**header["fields"], **arrays}
        low, gain = map(float, header.get("levels", (0.0, 1.0)))
        known = kind in KINDS
        if not (abs(low) <= 1 <= gain <= _MOST_GAIN):
            raise ValueError(f"levels of {low} and {gain}")
    except (DataError, KeyError, TypeError, ValueError, OverflowError, AttributeError, RecursionError) as error:
        raise DataError(f"{source}: expected a stage file of turbrestore, found something else or damage") from error
    if type(schema) is not int or schema != SCHEMA or not known:
        raise DataError(
            f"{source}: expected a stage file of layout {SCHEMA}, found a {kind!r:.40} of layout {schema!r:.40}"
        )
    result = convert_to(KINDS[kind], fields, str(source))
    check_fields(kind, result, str(source))
    return result, Levels(low, gain)


def _image_of(source: Path, result: DataclassInstance) -> FloatArray:
    if not isinstance(result, Centroid | Filtered | Deconvolution):
        raise DataError(f"{source}: expected a stage file with an image, found a {_kind_of(type(result))} stage file")
    return result.image


def _kind_of(cls: type) -> str:
    for name, known in KINDS.items():
        if known is cls:
            return name
    raise DataError(f"stage file: expected one of {', '.join(KINDS)}, found {cls.__name__}")
