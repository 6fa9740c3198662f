"""One command a stage: stage file in, stage file out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from turbrestore.core.errors import DataError, require
from turbrestore.core.remarks import counted
from turbrestore.deconvolution.deconvolve import Deconvolution
from turbrestore.display.figure import new_figure
from turbrestore.display.maps import plot_images
from turbrestore.display.spectra import plot_prediction
from turbrestore.dynamics.dynamic_texture import DynamicsParams
from turbrestore.dynamics.dynamic_texture import identify as identify_flows
from turbrestore.dynamics.flow_model import FlowDynamics, predict_flow, project_deviation
from turbrestore.dynamics.prediction import PredictionStudy, flow_error, study_prediction
from turbrestore.filtering.alternating import Filtered, FilterParams, FilterStep, filter_steps
from turbrestore.io.images.image_files import write_image
from turbrestore.io.output import IMAGE_OUTPUT_SUFFIXES, check_output, check_space, size_text
from turbrestore.io.source import FrameSource
from turbrestore.registration.centroid import Centroid, CentroidParams, centroid_steps
from turbrestore.registration.flow import FlowParams, estimate_flow, iterate_flows
from turbrestore.registration.flow_algebra import invert_flow
from turbrestore.registration.warp import warp
from turbrestore.runs.stage_files import load_artifact, load_flows, save_artifact
from turbrestore.runtime.steps import finish, step_counter

from .inputs import files_read, frames_to_train, open_input, read_input_image
from .options import Flag, Machine, Selection
from .output import FLOW_FILE, print_json, write_figure, write_flows
from .progress import progress_bars, say

STAGE_FILE, PICTURE = (".npz",), (".png",)


def centroid(
    input: Path,
    output: Path,
    /,
    *,
    train: int | None = None,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    centroid: CentroidParams = CentroidParams(),
    flow: FlowParams = FlowParams(),
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    quiet: Flag = False,
) -> None:
    """Find the centroid of the training frames of a video.

    Parameters
    ----------
    input : Path
        Video.  Only ``restore`` takes out bars, overlays and changing light, and stretches a small range.
    output : Path
        Stage file to write, .npz; it holds the flows as well.
    train : int
        Frames to use, from the first on; all that --frames names, or by default as many as restore trains on.
    centroid : CentroidParams
        Centroid iteration.
    flow : FlowParams
        Optical flow.
    overwrite : bool
        Replace an existing output.
    quiet : bool
        Print neither progress nor remarks.
    """
    check_output(output, files_read(selection, input), overwrite, STAGE_FILE)
    source = open_input(input, selection, quiet)
    count = frames_to_train(source, selection, train)
    check_space(output, _flow_bytes(count, source.shape) + _image_bytes(source.shape))
    with progress_bars(quiet) as progress:
        steps = centroid_steps(source.read(0, count), centroid, flow, machine.runtime())
        found = finish(steps, step_counter(progress, "centroid", count * centroid.iterations))
    save_artifact(output, found, overwrite)
    sizes = ", ".join(f"{size:.2f}" for size in found.mean_flow_sizes)
    say(f"{output}: centroid of {counted(count, 'frame')}, mean flow {sizes} pixels", quiet)


def flow(
    reference: Path,
    input: Path,
    output: Path,
    /,
    *,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    flow: FlowParams = FlowParams(),
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    quiet: Flag = False,
) -> None:
    """Measure the flow from one image to every frame of a video.

    Parameters
    ----------
    reference : Path
        Image, or centroid stage file.
    input : Path
        Video.
    output : Path
        Flows to write, pixels: .npy of shape (T, H, W, 2), or .fits with the reference as its image and the extension
        FLOW of shape (T, 2, H, W).
    flow : FlowParams
        Optical flow.
    overwrite : bool
        Replace an existing output.
    quiet : bool
        Print neither progress nor remarks.
    """
    check_output(output, files_read(selection, reference, input), overwrite, FLOW_FILE)
    image = read_input_image(reference, selection.limits())
    source = open_input(input, selection, quiet)
    check_space(output, _flow_bytes(len(source), source.shape))
    with progress_bars(quiet) as progress:
        flows = np.empty((*source.shape[:3], 2), np.float32)
        count = step_counter(progress, "flow", len(source))
        for measured, (_, found) in zip(flows, iterate_flows(image, source, flow, machine.runtime()), strict=True):
            measured[...] = found
            count(found)
    write_flows(output, flows, image, source, reference, overwrite)
    say(
        f"{output}: {counted(len(flows), 'flow')}, root mean square {float(np.sqrt(np.mean(flows**2))):.2f} pixels",
        quiet,
    )


def identify(
    flows: Path,
    output: Path,
    /,
    *,
    plot: Path | None = None,
    dynamics: DynamicsParams = DynamicsParams(),
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    quiet: Flag = False,
) -> None:
    """Identify the dynamics of flows.

    Parameters
    ----------
    flows : Path
        Centroid stage file (.npz), or flows (.npy).
    output : Path
        Stage file to write, .npz.
    plot : Path
        Picture to write, .png: error of one-step prediction, and eigenvalues, by length of the training and number of
        states (Figure 7 of the paper).  Needs matplotlib.
    dynamics : DynamicsParams
        Dynamic texture of the flow.
    overwrite : bool
        Replace an existing output.
    quiet : bool
        No remarks.
    """
    check_output(output, [flows], overwrite, STAGE_FILE)
    if plot is not None:
        check_output(plot, [flows, output], overwrite, PICTURE)
        new_figure()
    measured = load_flows(flows)
    most = int(len(measured) / dynamics.frames_per_state) if dynamics.rank is None else dynamics.rank
    modes = min(most, dynamics.max_rank if dynamics.rank is None else len(measured))
    # The mean flow is one more.
    check_space(output, _flow_bytes(modes + 1, measured.shape))
    found = identify_flows(measured, dynamics, machine.runtime())
    save_artifact(output, found, overwrite)
    if plot is not None:
        _plot_study(plot, study_prediction(measured, dynamics, machine.runtime()), overwrite, quiet)
    for note in found.notes:
        say(f"{output}: {note}", quiet)
    say(f"{output}: {counted(found.rank, 'state')} with {100 * found.energy_share:.1f} % of the motion", quiet)


def predict(
    input: Path,
    centroid: Path,
    dynamics: Path,
    output: Path,
    /,
    *,
    frame: int | None = None,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    flow: FlowParams = FlowParams(),
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
) -> None:
    """Predict a frame of a video from the one before, and compare it with what was measured.

    Parameters
    ----------
    input : Path
        Video; its first frames are those that the centroid was found from.
    centroid : Path
        Centroid stage file.
    dynamics : Path
        Dynamics stage file.
    output : Path
        Picture to write, .png: the frame, the predicted one, the centroid, and their differences (Figure 8 of the
        paper).  Needs matplotlib.
    frame : int
        Frame to predict, counted from 0; by default the first after the training, or the last if all were trained on.
    flow : FlowParams
        Optical flow.
    overwrite : bool
        Replace an existing output.
    json : bool
        Print the errors as JSON.
    quiet : bool
        No remarks.
    """
    check_output(output, files_read(selection, input, centroid, dynamics), overwrite, PICTURE)
    new_figure()
    start, model = load_artifact(centroid, Centroid), load_artifact(dynamics, FlowDynamics)
    source = open_input(input, selection, quiet)
    _check_shapes(source, start, model)
    number = min(model.frame_count, len(source) - 1) if frame is None else frame
    require(1 <= number < len(source), f"--frame: expected a frame from 1 to {len(source) - 1}, found {number}")
    before, actual = source.read(number - 1, number + 1)
    last, measured = estimate_flow(start.image, np.stack([before, actual]), flow, machine.runtime())
    predicted = predict_flow(model, project_deviation(model, last - model.mean_flow))
    image = warp(start.image, invert_flow(predicted))
    errors = {
        "flow": {
            name: flow_error(found, measured)
            for name, found in (("predicted", predicted), ("last", last), ("mean", model.mean_flow))
        },
        "image": {
            name: float(np.sqrt(np.mean(np.square(found - actual), dtype=np.float64)))
            for name, found in (("predicted", image), ("last", before), ("centroid", start.image))
        },
    }
    if number < model.frame_count:
        say(f"{output}: frame {number} is one that the dynamics were found from, so its flow is fitted better", quiet)
    pictures = {
        f"frame {number}": actual,
        "predicted": image,
        "centroid": start.image,
        "predicted, difference + 0.5": image - actual + 0.5,
        "centroid, difference + 0.5": start.image - actual + 0.5,
    }
    write_figure(output, plot_images(pictures), overwrite)
    if json:
        print_json({"frame": number, "flow_error": errors["flow"], "image_error": errors["image"]})
    flows = ", ".join(f"{name} {error:.2f}" for name, error in errors["flow"].items())
    images = ", ".join(f"{name} {error:.4f}" for name, error in errors["image"].items())
    say(f"{output}: frame {number}: error of the flow, pixels: {flows}; of the image: {images}", quiet)


def filter_(
    input: Path,
    centroid: Path,
    dynamics: Path,
    output: Path,
    /,
    *,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    filter: FilterParams = FilterParams(),
    flow: FlowParams = FlowParams(),
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    quiet: Flag = False,
) -> None:
    """Filter a video with known centroid and dynamics.

    Parameters
    ----------
    input : Path
        Video; its first frames are those that the centroid was found from.
        Only ``restore`` takes out bars, overlays and changing light, and stretches a small range.
    centroid : Path
        Centroid stage file.
    dynamics : Path
        Dynamics stage file.
    output : Path
        Stage file (.npz) or image (.png, .tif) to write.
    filter : FilterParams
        Alternating-estimation Kalman filter.
    flow : FlowParams
        Optical flow.
    overwrite : bool
        Replace an existing output.
    quiet : bool
        Print neither progress nor remarks.
    """
    inputs = files_read(selection, input, centroid, dynamics)
    check_output(output, inputs, overwrite, STAGE_FILE + tuple(IMAGE_OUTPUT_SUFFIXES))
    start, model = load_artifact(centroid, Centroid), load_artifact(dynamics, FlowDynamics)
    source = open_input(input, selection, quiet)
    check_space(output, _image_bytes(source.shape))
    total = len(source) * filter.inner_iterations - len(start.flows)
    with progress_bars(quiet) as progress:

        def observe(step: FilterStep) -> None:
            if progress is not None:
                progress("filter", step.flows_measured, total)

        steps = filter_steps(source, start.image, model, filter, flow, start.flows, machine.runtime())
        filtered = finish(steps, observe).recentred()
    write_stage(output, filtered, source.bit_depth, overwrite)
    say(f"{output}: {counted(len(source), 'frame')} filtered", quiet)


def _plot_study(plot: Path, study: PredictionStudy, overwrite: bool, quiet: bool) -> None:
    baselines = {"flow before, repeated": study.repeated, "mean flow": study.mean}
    figure = plot_prediction(study.lengths, study.ranks, study.errors, study.eigenvalues, baselines)
    write_figure(plot, figure, overwrite)
    row, column = np.unravel_index(np.nanargmin(study.errors), study.errors.shape)
    best = f"{study.errors[row, column]:.2f} pixels with τ = {study.lengths[row]}, n = {study.ranks[column]}"
    others = ", ".join(f"{name} {error:.2f}" for name, error in baselines.items())
    say(f"{plot}: least error of {study.count} predicted flows {best}; {others}", quiet)


def _check_shapes(source: FrameSource, start: Centroid, model: FlowDynamics) -> None:
    """Refuse stage files of other frames: of another size, or grey where these have colours."""
    expected = source.shape[1:]
    if start.image.shape != expected or model.shape != expected[:2]:
        found = f"a centroid of {size_text(start.image.shape)} and dynamics of {size_text(model.shape)}"
        raise DataError(f"{source.name}: expected stage files of its frames, {size_text(expected)}, found {found}")


def _flow_bytes(count: int, shape: tuple[int, ...]) -> int:
    """Bytes of so many flows between frames of a stack of this shape."""
    return 8 * count * shape[1] * shape[2]


def _image_bytes(shape: tuple[int, ...]) -> int:
    """Bytes of an image in full precision, in one channel at least."""
    return 4 * shape[1] * shape[2]


def write_stage(output: Path, result: Filtered | Deconvolution, bit_depth: int, overwrite: bool) -> None:
    """Write the result of a stage, or its image alone, as the suffix says."""
    if output.suffix.lower() in STAGE_FILE:
        save_artifact(output, result, overwrite)
    else:
        write_image(output, result.image, bit_depth, overwrite)
