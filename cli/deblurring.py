"""``turbrestore deconvolve``: deblur an image or the filtered image of a kept run, or compare widths of the blur."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from cyclopts import Parameter

from turbrestore.blur.estimation import BlurEstimate
from turbrestore.blur.measured_psf import psf_from_image
from turbrestore.blur.posterior import BlurPosterior
from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.core.errors import ConfigurationError, InputNotFoundError, require, require_between
from turbrestore.core.gradient import sobel_gradient
from turbrestore.core.remarks import counted
from turbrestore.deblurring.guards import GuardParams, evaluate_guards
from turbrestore.deblurring.remove_blur import remove_blur_steps
from turbrestore.deconvolution.deconvolve import Deconvolution, DeconvolutionParams
from turbrestore.deconvolution.deconvolve import deconvolve as deconvolve_image
from turbrestore.deconvolution.problem import largest_width
from turbrestore.display.figure import new_figure
from turbrestore.display.maps import plot_images
from turbrestore.io.images.image_files import read_image
from turbrestore.io.limits import Limits
from turbrestore.io.output import IMAGE_OUTPUT_SUFFIXES, check_output
from turbrestore.runs.stage_files import load_artifact
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.steps import finish, step_counter

from .inputs import read_guide, read_input_image
from .options import Flag, Machine, known_sigma, limits_of
from .output import check_output_depth, write_figure
from .progress import progress_bars, say
from .stages import STAGE_FILE, write_stage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Side of the part that a contact sheet shows, pixels; most widths, and panels in a row.
PART, MOST_WIDTHS, COLUMNS = 256, 12, 4


def deconvolve(
    input: Path,
    output: Path | None = None,
    /,
    *,
    sigma: float | None = None,
    psf: Path | None = None,
    sweep: str | None = None,
    guide: Path | None = None,
    deconvolution: DeconvolutionParams = DeconvolutionParams(),
    guards: GuardParams = GuardParams(),
    bit_depth: int | None = None,
    max_pixels: int | None = None,
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    quiet: Flag = False,
) -> None:
    """Deblur an image.

    Parameters
    ----------
    input : Path
        Image, stage file, or folder of a kept run.  Of a run the filtered image is deblurred, guided by the centroid,
        by the width that the run measured and removed.
    output : Path
        Image (.png, .tif) or stage file (.npz) to write.  With --sweep a contact sheet, .png, by default sweep.png in
        the folder of the run.
    sigma : float
        Width of the blur, pixels.  A Gaussian unless --deconvolution.exponent says otherwise; by default that of the
        run, else estimated.
    psf : Path
        Image of a star, or a measured point spread function, in pixels of the input.  It is removed instead of a blur
        of some width.
    sweep : str
        Widths to compare, such as ``1,1.4,2``.  The contact sheet shows the part of the image with the most detail
        after each, without guards; what they object to is in the title.
    guide : Path
        Image or stage file that the nonlocal weights are taken from; the input by default, the centroid in the paper,
        which is moved onto the geometry of a filtered image.
    deconvolution : DeconvolutionParams
        Method and its settings.
    guards : GuardParams
        What the result must not exceed where the width is estimated.
    bit_depth : int
        Bits per channel of an image that is written: 8, 16 or 32; by default those of the input, 16 for stage files.
    max_pixels : int
        Largest image to read, pixels; by default 67 million.
    overwrite : bool
        Replace an existing output.
    quiet : bool
        Print neither progress nor remarks.
    """
    source, beside = stage_of_run(input)
    guide = beside if guide is None else guide
    if sweep is not None:
        require(sigma is None and psf is None, "--sweep: contradicts --sigma and --psf; leave one of them out")
        sheet = _sheet_path(input, output)
        check_output(sheet, [source], overwrite, (".png",))
        images = _read(source, guide, limits_of(max_pixels))
        widths = widths_of(sweep, images[0].shape)
        write_figure(sheet, contact_sheet(*images, widths, deconvolution, guards, machine.runtime()), overwrite)
        say(f"{sheet}: {counted(len(widths), 'width')} side by side", quiet)
        return
    require(output is not None, "OUTPUT: expected an image or a stage file to write, found none")
    assert output is not None
    deconvolution = known_sigma(sigma, deconvolution)
    of_run = input.is_dir() and psf is None and deconvolution.sigma is None
    if of_run:
        deconvolution = _as_in_run(input, deconvolution)
    require(psf is None or deconvolution.sigma is None, "--psf: contradicts --sigma; leave one of them out")
    if bit_depth is not None:
        check_output_depth(bit_depth, output.suffix)
        require(output.suffix.lower() not in STAGE_FILE, "--bit-depth: has no effect on a stage file; leave it out")
    inputs = [path for path in (source, guide, psf) if path is not None]
    check_output(output, inputs, overwrite, STAGE_FILE + tuple(IMAGE_OUTPUT_SUFFIXES))
    limits = limits_of(max_pixels)
    image, guide_image = _read(source, guide, limits)
    require_between("--sigma", deconvolution.sigma or 0.0, 0, largest_width(image.shape), "pixels")
    kernel = None if psf is None else psf_from_image(read_input_image(psf, limits), str(psf))
    with progress_bars(quiet) as progress:
        steps = remove_blur_steps(image, guide_image, deconvolution, guards, machine.runtime(), psf=kernel)
        deblurred = finish(steps, step_counter(progress, "deconvolve", deconvolution.iterations))
    if bit_depth is None:
        bit_depth = 16 if source.suffix.lower() in STAGE_FILE else read_image(source, limits).bit_depth
    write_stage(output, deblurred.deconvolution, bit_depth, overwrite)
    for decision in deblurred.decisions:
        if of_run and decision.subject == "blur" and deconvolution.sigma is not None:
            say(f"{output}: {replace(decision, reason='as much as the run removed')}", quiet)
        else:
            say(f"{output}: {decision}", quiet)


def stage_of_run(path: Path) -> tuple[Path, Path | None]:
    """Return the stage file to deblur and its guide: of a folder those of a kept run, of a file itself and none."""
    if not path.is_dir():
        # Without a suffix it may be a folder that is not there.
        if not (path.suffix or path.exists() or str(path) == "-"):
            raise InputNotFoundError(f"{path}: no such file or folder")
        return path, None
    filtered, centroid = path / "filtered.npz", path / "centroid.npz"
    require(
        filtered.is_file(), f"{path}: expected the folder of a kept run with filtered.npz; restore --keep writes one"
    )
    return filtered, centroid


def _as_in_run(folder: Path, params: DeconvolutionParams) -> DeconvolutionParams:
    """Complete settings by the blur that the run measured and removed: it knows the frames as well."""
    posterior, blur = folder / "posterior.npz", folder / "blur.npz"
    if posterior.is_file():
        exponent = load_artifact(posterior, BlurPosterior).exponent
    elif blur.is_file():
        exponent = load_artifact(blur, BlurEstimate).exponent
    else:
        # The width or the point spread function was given.
        return params
    removed = load_artifact(folder / "deconvolution.npz", Deconvolution).sigma
    return replace(params, sigma=removed, exponent=params.exponent or exponent)


def widths_of(sweep: str, shape: tuple[int, ...], name: str = "--sweep") -> tuple[float, ...]:
    """Read widths for an image of this shape that are separated by commas; ``name`` is what errors call them."""
    try:
        widths = tuple(float(part) for part in sweep.split(","))
    except ValueError:
        raise ConfigurationError(f"{name}: expected widths such as 1,1.4,2, found {sweep!r}") from None
    require(len(widths) <= MOST_WIDTHS, f"{name}: expected at most {MOST_WIDTHS} widths, found {len(widths)}")
    for width in widths:
        require_between(name, width, 0, largest_width(shape), "pixels")
    return widths


def contact_sheet(
    image: FloatArray,
    guide: FloatArray,
    widths: tuple[float, ...],
    params: DeconvolutionParams,
    guards: GuardParams,
    runtime: Runtime,
) -> Figure:
    """Draw the part of an image with the most detail as it is, and deblurred by each width."""
    new_figure()
    return plot_images(dict(compared_widths(image, guide, widths, params, guards, runtime)), COLUMNS)


def compared_widths(
    image: FloatArray,
    guide: FloatArray,
    widths: tuple[float, ...],
    params: DeconvolutionParams,
    guards: GuardParams,
    runtime: Runtime,
) -> Iterator[tuple[str, FloatArray]]:
    """Deblur the most detailed part of an image by each width, with a title; the part itself comes first."""
    window = detailed_window(luminance(image))
    part, guided = image[window], guide[window]
    yield "not deblurred", part
    for width in widths:
        result = deconvolve_image(part, width, params, guided, runtime).image
        yield f"{width:g} px{_faults(result, part, width, guards)}", result


def _faults(result: FloatArray, part: FloatArray, width: float, guards: GuardParams) -> str:
    """End the title with what the guards object to."""
    if width == 0:
        return ""
    reading = evaluate_guards(result, part, width, guards)
    bounds = (
        ("rings", reading.ringing, guards.ringing),
        ("overshoots", reading.overshoot, guards.overshoot),
        ("is noisy", reading.noise_gain, guards.noise_gain),
    )
    faults = [word for word, value, bound in bounds if value > bound]
    return f": {', '.join(faults)}" if faults else ""


def detailed_window(image: FloatArray) -> tuple[slice, slice]:
    """Rows and columns of the part with the steepest edges, moved in steps of half its side."""
    strength = np.hypot(*sobel_gradient(image))
    places = [
        (y, x)
        for y in range(0, max(image.shape[0] - PART, 0) + 1, PART // 2)
        for x in range(0, max(image.shape[1] - PART, 0) + 1, PART // 2)
    ]
    y, x = max(places, key=lambda place: float(strength[place[0] : place[0] + PART, place[1] : place[1] + PART].sum()))
    return slice(y, y + PART), slice(x, x + PART)


def _read(source: Path, guide: Path | None, limits: Limits) -> tuple[FloatArray, FloatArray]:
    image = read_input_image(source, limits)
    return image, image if guide is None else read_guide(guide, source, limits)


def _sheet_path(input: Path, output: Path | None) -> Path:
    """Where the contact sheet goes: beside what it is made of, unless it is named."""
    if output is not None:
        return output
    return input / "sweep.png" if input.is_dir() else input.with_name(f"{input.stem}.sweep.png")
