"""What is written comes back: every writer with its reader, on arrays and records that hypothesis makes up."""

import dataclasses
import functools
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from turbrestore.core.decision import Decision
from turbrestore.deblurring.guards import GuardReading
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.dynamics.dynamic_texture import DynamicsParams
from turbrestore.filtering.alternating import Filtered, FilterParams
from turbrestore.footage.frame_selection import Share
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.video import open_frames, write_video
from turbrestore.pipeline import Restoration, RestoreParams
from turbrestore.registration.centroid import Centroid, CentroidParams
from turbrestore.registration.flow import FlowParams
from turbrestore.runs.run_files import load_run, save_run
from turbrestore.runs.run_record import RunRecord
from turbrestore.runs.stage_files import KINDS, load_artifact, load_flows, save_artifact, save_flows
from turbrestore_cli.commands import build
from turbrestore_cli.options import Machine, Selection
from turbrestore_cli.output import settings_record, write_settings

EXAMPLES = 200
SIDES = st.integers(1, 9)
NUMBERS = st.floats(-1e6, 1e6, allow_subnormal=False)
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)


def raw(dtype, shape):
    """Arrays of any bits; drawn as bytes, which is far quicker than number by number."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return st.binary(min_size=size, max_size=size).map(lambda data: np.frombuffer(data, dtype).reshape(shape).copy())


def levels(depth, least=1, counts=None):
    """Pixels as a file of whole numbers has them; grey or RGB, one image or a stack."""
    kind = np.uint8 if depth <= 8 else np.uint16
    sides = st.integers(least, 9)
    stacks = st.just(()) if counts is None else st.tuples(counts)
    shapes = st.tuples(stacks, sides, sides, st.sampled_from([(), (3,)]))
    return shapes.flatmap(lambda parts: raw(kind, (*parts[0], *parts[1:3], *parts[3]))).map(
        lambda pixels: pixels & kind(2**depth - 1)
    )


def unit(pixels, depth):
    """Intensities that stand for whole numbers."""
    return (pixels / np.float32(2**depth - 1)).astype(np.float32)


def floats(*shape, scale=1.0):
    """Arrays of floating point from 0 to ``scale``."""
    return raw(np.uint32, shape).map(lambda bits: (bits / 2.0**32 * scale).astype(np.float32))


def same(found, expected):
    """Equal down to every bit of every array."""
    assert type(found) is type(expected)
    if dataclasses.is_dataclass(expected):
        for item in dataclasses.fields(expected):
            same(getattr(found, item.name), getattr(expected, item.name))
    elif isinstance(expected, tuple):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            same(one, other)
    elif isinstance(expected, np.ndarray):
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
        assert found.tobytes() == expected.tobytes()
    else:
        assert found == expected


def image_file(suffix, depth, folder, pixels):
    """Write and read an image."""
    path = folder / f"a{suffix}"
    write_image(path, pixels if depth == 32 else unit(pixels, depth), depth, overwrite=True)
    found = read_image(path)
    assert found.bit_depth == depth
    same(found.image, pixels if depth == 32 else unit(pixels, depth))


def clip_file(suffix, depth, folder, pixels):
    """Write and read a clip."""
    path = folder / f"a{suffix}"
    frames = pixels if depth == 32 else unit(pixels, depth)
    write_video(path, frames, 25, depth, overwrite=True)
    found = open_frames(path)
    assert found.bit_depth == depth
    assert found.fps in (None, pytest.approx(25)) and (found.fps is not None or suffix != ".mkv")
    same(np.asarray(found.read()), frames)


def flow_file(folder, flows):
    """Write and read flows."""
    save_flows(folder / "f.npy", flows, overwrite=True)
    same(np.array(load_flows(folder / "f.npy")), flows)


def artifact(folder, result):
    """Write and read an artifact."""
    save_artifact(folder / "a.npz", result, overwrite=True)
    same(load_artifact(folder / "a.npz", type(result)), result)


def settings_file(folder, chosen):
    """Write settings, and let the command line read them."""
    params, selection, bit_depth = chosen
    path = folder / "run.toml"
    record = settings_record(params, selection, bit_depth, Machine(), None)
    write_settings(path, record)
    words = ["restore", "a.mkv", "o.png", f"--config={path}"]
    _, bound, _ = APP().parse_args(words, exit_on_error=False, print_error=False)
    found = bound.arguments
    same(found.get("params", RestoreParams()), params)
    same(found.get("selection", Selection()), selection)
    assert found.get("bit_depth") == bit_depth
    assert tomllib.loads(path.read_text("utf-8"))["train"] == params.train


def kept_run(folder, kept):
    """Keep a run, and read it back."""
    restoration, run = kept
    save_run(folder / "kept", restoration, run)
    found, record = load_run(folder / "kept")
    same(found, restoration)
    same(record, run)


APP = functools.cache(build)


# What a stage can make: shapes that fit together, values from 0 to 1, and a covariance.
def results(kind):
    """Results of a stage with every field made up."""
    shapes = st.tuples(st.integers(2, 5), st.integers(2, 5), st.integers(1, 3))
    return shapes.flatmap(lambda shape: st.builds(kind, **_fields(kind, *shape)))


def _fields(kind, height, width, count):
    dims = {
        "image": (height, width), "variance": (height, width), "flows": (count, height, width, 2),
        "C": (height * width * 2, count), "A": (count, count), "mean_flow": (height, width, 2),
        "residual_variance": (height, width), "states": (count, count + 1),
        "singular_values": (count + 1,), "flow_states": (count, 2),
        **dict.fromkeys(("width", "by_displacement", "by_variation", "by_image", "by_tones"), (3,)),
    }  # fmt: skip
    scalars = {"float": st.floats(0, 1), "int": st.integers(1, 10**9), "bool": st.booleans()}
    scalars["tuple[str, ...]"] = st.lists(TEXT, max_size=3).map(tuple)
    found = {}
    for item in dataclasses.fields(kind):
        text, shape = str(item.type), dims.get(item.name, (count,))
        if text in scalars:
            found[item.name] = scalars[text]
        elif item.name == "Q":
            found["Q"] = raw(np.uint32, (count, count)).map(lambda bits: (bits / 2.0**32) @ (bits / 2.0**32).T)
        elif "int64" in text:
            found[item.name] = raw(np.uint16, shape).map(np.int64)
        else:
            found[item.name] = (
                floats(*shape) if text == "FloatArray" else raw(np.uint32, shape).map(lambda x: x / 2**32)
            )
    return found


@st.composite
def chosen_settings(draw):
    """Settings of all stages, in ranges that they take."""
    few = st.integers(1, 20)
    share = st.floats(0.0625, 1.0, width=16)
    params = RestoreParams(
        train=draw(st.integers(2, 1000)),
        keep_best=Share(draw(share)),
        border=draw(st.sampled_from(["keep", "crop"])),
        flow=FlowParams(method=draw(st.sampled_from(["dis", "tvl1", "farneback"])), global_shift=draw(st.booleans())),
        centroid=CentroidParams(iterations=draw(few), tolerance=draw(st.floats(0.01, 1.0))),
        dynamics=DynamicsParams(rank=draw(st.none() | few), energy=draw(share)),
        filter=FilterParams(block=draw(few), sharpness=draw(st.floats(0.0, 4.0))),
        deconvolution=DeconvolutionParams(sigma=draw(st.none() | st.floats(0.1, 3.0)), iterations=draw(few)),
    )
    frames = st.builds("{}:{}".format, few, st.integers(30, 99))
    selection = Selection(
        frames=draw(st.none() | frames),
        roi=draw(st.none() | st.just("1,2,64,48")),
        strict=draw(st.booleans()),
        max_pixels=draw(st.none() | st.integers(1, 10**8)),
    )
    return params, selection, draw(st.sampled_from([None, 8, 16, 32]))


READINGS = st.builds(GuardReading, NUMBERS, NUMBERS, NUMBERS, NUMBERS, st.booleans())


@st.composite
def kept_runs(draw):
    """Runs that stopped after the centroid or went through."""
    centroid = draw(results(Centroid))
    height, width = centroid.image.shape
    filtered = draw(st.none() | st.builds(Filtered, **_fields(Filtered, height, width, 2)))
    restoration = Restoration(
        image=draw(floats(height, width)),
        crop=(0, 0, width, height),
        mean=draw(floats(height, width)),
        centroid=centroid,
        dynamics=None,
        filtered=filtered,
        blur=None,
        deconvolution=None,
        guard_readings=tuple(draw(st.lists(READINGS, max_size=2))),
        decisions=tuple(draw(st.lists(st.builds(Decision, TEXT, TEXT, TEXT), max_size=2))),
        train=draw(st.integers(2, 99)),
        frame_count=draw(st.integers(2, 999)),
        seconds=draw(st.dictionaries(TEXT, st.floats(0, 1e6), max_size=3)),
    )
    run = RunRecord(
        name=draw(TEXT),
        frame=draw(floats(height, width)),
        frame_number=draw(st.integers(0, 10**6)),
        source=draw(TEXT),
        settings=draw(st.dictionaries(TEXT, st.none() | NUMBERS | TEXT | st.booleans(), max_size=3)),
        command=tuple(draw(st.lists(TEXT, max_size=3))),
        warnings=tuple(draw(st.lists(TEXT, max_size=3))),
        versions=draw(st.dictionaries(TEXT, TEXT, max_size=3)),
    )
    return restoration, run


STACKS = st.tuples(st.integers(2, 3), SIDES, SIDES).flatmap(lambda shape: floats(*shape))
PAIRS = {
    "PNG, 8 bits": (functools.partial(image_file, ".png", 8), levels(8)),
    "PNG, 16 bits": (functools.partial(image_file, ".png", 16), levels(16)),
    "TIFF, 8 bits": (functools.partial(image_file, ".tif", 8), levels(8)),
    "TIFF, 16 bits": (functools.partial(image_file, ".tif", 16), levels(16)),
    "TIFF, float": (
        functools.partial(image_file, ".tif", 32),
        st.tuples(SIDES, SIDES).flatmap(lambda shape: floats(*shape)),
    ),
    **{
        f"{name}, {depth} bits": (functools.partial(clip_file, suffix, depth), levels(depth, least, st.integers(1, 3)))
        for name, suffix, depths, least in (
            ("npy frames", ".npy", (8, 16), 1),
            ("TIFF stack", ".tif", (8, 16), 1),
            ("SER", ".ser", (1, 8, 12, 16), 1),
            ("FFV1", ".mkv", (8, 10, 12, 14, 16), 2),
        )
        for depth in depths
    },
    "npy frames, float": (functools.partial(clip_file, ".npy", 32), STACKS),
    "TIFF stack, float": (functools.partial(clip_file, ".tif", 32), STACKS),
    "flows": (
        flow_file,
        st.tuples(st.integers(1, 3), SIDES, SIDES).flatmap(lambda shape: floats(*shape, 2, scale=-99.0)),
    ),
    **{f"artifact: {name}": (artifact, results(kind)) for name, kind in KINDS.items()},
    "settings": (settings_file, chosen_settings()),
    "kept run": (kept_run, kept_runs()),
}


def passed(name, examples=EXAMPLES):
    """Examples of a pair that came back; the first that does not raises, with what it was."""
    check, strategy = PAIRS[name]
    count = 0

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate],
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    @given(strategy)
    def run(value):
        nonlocal count
        check(folder, value)
        count += 1

    # Every file is flushed to its disk, which takes its time where that is one.
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as place:
        folder = Path(place)
        run()
    return count


@pytest.mark.parametrize("name", PAIRS)
def test_what_is_written_comes_back(name):
    # As many as a quick test allows; benchmarks/robustness.py runs all.
    examples = 20
    assert passed(name, examples) >= examples


@pytest.mark.parametrize("name", ["PNG, 8 bits", "flows", "artifact: centroid", "settings"])
def test_a_difference_is_seen(name, monkeypatch):
    def spoilt(found, expected):
        raise AssertionError(f"{found} is not {expected}")

    monkeypatch.setitem(globals(), "same", spoilt)
    with pytest.raises(AssertionError, match="is not"):
        passed(name, 2)
