"""``turbrestore restore``: its options.  What it does is imported when it runs, so that its help comes at once."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from turbrestore.core.errors import require
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.settings import Preset, RestoreParams

from .options import Flag, Machine, Selection, known_sigma

# Longest side of the tiles that are shared among processes, pixels: halos of a fifth on either side.
TILE = 1088


def restore(
    input: Path,
    output: Path,
    /,
    *,
    preset: Preset = "standard",
    sigma: float | None = None,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    config: Path | None = None,
    keep: Path | None = None,
    resume: Flag = False,
    checkpoint_every: int = 50,
    report: Path | None = None,
    uncertainty: Path | None = None,
    truth: Path | None = None,
    bit_depth: int | None = None,
    memory_limit: MemorySize | None = None,
    tile: int | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
    verbose: Flag = False,
    # Last, so that the help lists what is often used before the settings of every stage.
    params: Annotated[RestoreParams, Parameter(name="*")] = RestoreParams(),
) -> None:
    """Restore one sharp image from a video of a static scene.

    Parameters
    ----------
    input : Path
        Video, SER, FITS, TIFF, .npy or folder of images.  A video is what FFmpeg reads (mp4, mkv, mov, avi, mts, wmv,
        …) or an animated PNG or WebP; a FITS file is a cube; a folder may hold FITS files.
    output : Path
        Image to write: .png, .tif or .fits.  PNG has 8 or 16 bits, TIFF and FITS have floating point as well, and FITS
        has the header of a FITS input and the history of the run.
    preset : str
        Settings to start from.  fast measures flow once a frame and at a quarter of the size, in three quarters of the
        time; paper is the method as published.  Any other setting given wins over those of the preset.
    sigma : float
        Width of the blur to remove, pixels.  Its standard deviation; 0 removes none.  Estimated by default.
    config : Path
        File with settings, .toml; options win over it.
    keep : Path
        Folder for the result of every stage.  Each is written as it is done.
    resume : bool
        Continue the run in the folder of ``--keep``.  Stages that a changed input or setting affects are
        computed again.
    checkpoint_every : int
        Frames between two checkpoints of the filter in the ``--keep`` folder.
    report : Path
        Page to write, .html: images, reasons, plots.
    uncertainty : Path
        Image to write, .tif: the standard deviation of every pixel of the result, in floating point, infinite where
        nothing is known.
    truth : Path
        Image of the true scene: every stage is compared with it.
    bit_depth : int
        Bits per channel of the image: 8, 16 or 32.  32 is floating point, in TIFF and FITS only.  Those of the input by
        default.
    memory_limit : MemorySize
        Most memory to take, such as 2GB.  By default there is no limit.  To keep it, training frames go to a scratch
        file, fewer threads work, fewer frames are trained on, and frames are processed in tiles that overlap, in this
        order.  With --workers, what all processes together take; with --scheduler, what each takes.
    tile : int
        Longest side of the tiles that larger frames are processed in, pixels.  By default frames are processed as a
        whole; with --workers or --scheduler it is 1088.
    scheduler : str
        Address of a running Dask scheduler, tcp://host:port.  Its workers process the tiles and must see the same
        files.
    workers : int
        Processes to start on this machine, to work on the tiles.
    overwrite : bool
        Replace existing outputs.
    json : bool
        Print the facts of the run as JSON.  They go to standard output.
    quiet : bool
        Print neither progress nor remarks.
    verbose : bool
        Print every decision as it is made.
    """
    from .clip import Order, restore_clip
    from .cluster import check_cluster
    from .inputs import read_input_image
    from .output import describe, print_json, summary
    from .progress import say

    require(not (quiet and verbose), "--verbose: contradicts --quiet; leave one of them out")
    settings = dataclasses.replace(params, deconvolution=known_sigma(sigma, params.deconvolution))
    if scheduler is not None or workers is not None:
        check_cluster("restore", scheduler, workers)
        tile = TILE if tile is None else tile
    order = Order(
        input=input,
        output=output,
        selection=selection,
        params=settings,
        machine=machine,
        bit_depth=bit_depth,
        memory_limit=memory_limit,
        preset=preset,
        config=config,
        keep=keep,
        resume=resume,
        checkpoint_every=checkpoint_every,
        report=report,
        uncertainty=uncertainty,
        truth=truth,
        overwrite=overwrite,
        quiet=quiet,
        verbose=verbose,
        tile=tile,
        scheduler=scheduler,
        workers=workers,
    )
    restoration, source = restore_clip(order)
    if json:
        # The truth is read again, so that it takes no memory while the stages run.
        facts = describe(restoration, None if truth is None else read_input_image(truth, selection.limits()))
        paths = {"input": str(input), "output": str(output), "settings": str(order.settings_path)}
        print_json({**paths, "warnings": list(source.warnings), **facts})
    else:
        say(summary(output, restoration), quiet)
