"""Whatever the bytes: a reader gives frames in [0, 1] or one of the errors that are meant, never anything else."""

import contextlib
import dataclasses
import json
import struct
import warnings
import zipfile

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from turbrestore.blur.estimation import BlurEstimate
from turbrestore.blur.posterior import BlurWitnesses, blur_posterior
from turbrestore.core.errors import TurbrestoreError
from turbrestore.core.noise_spectrum import fit_noise_spectrum
from turbrestore.deconvolution.deconvolve import Deconvolution, DeconvolutionParams, deconvolve
from turbrestore.dynamics.dynamic_texture import DynamicsParams, identify
from turbrestore.dynamics.flow_model import FlowDynamics
from turbrestore.filtering.alternating import Filtered, FilterParams, filter_frames
from turbrestore.footage.checks.content import check_content, clean_source
from turbrestore.io.images.image_files import read_image
from turbrestore.io.limits import Limits
from turbrestore.io.npy import map_npy, read_npz
from turbrestore.io.video import open_frames, write_video
from turbrestore.registration.centroid import Centroid
from turbrestore.runs.stage_files import KINDS, load_artifact, save_artifact

SMALL = Limits(max_pixels=10_000, max_frames=200, max_bytes=10**6)
FRAMES = np.random.default_rng(0).random((3, 8, 10), dtype=np.float32)
# Shared folders are fine here: every example writes the same file anew.
MANY = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

CHANGES = st.lists(
    st.tuples(st.sampled_from(["set", "cut", "insert", "repeat"]), st.floats(0, 1), st.binary(min_size=1, max_size=8)),
    min_size=1,
    max_size=4,
)


CLIP = np.random.default_rng(1).random((4, 16, 16), dtype=np.float32)
FAST = FilterParams(inner_iterations=1)


def make_results():
    """One small result of every kind."""
    flows = np.random.default_rng(2).normal(size=(6, 16, 16, 2)).astype(np.float32)
    dynamics = identify(flows, DynamicsParams(rank=2))
    return {
        "centroid": Centroid(CLIP[0], flows, np.ones(2), True),
        "dynamics": dynamics,
        "filtered": filter_frames(CLIP, CLIP[0], dynamics, FAST),
        "deconvolution": deconvolve(CLIP[0], 1.0, DeconvolutionParams(method="tv", iterations=5)),
        "blur": BlurEstimate(1.0, 0.1, 5 / 3, 0.01, 1, 9.0, np.arange(3.0), np.ones(3)),
        "posterior": blur_posterior(None, BlurWitnesses(1.0, 9.0)),
        "noise": fit_noise_spectrum([CLIP[1] - CLIP[0]], CLIP[0]),
    }


WHOLE = make_results()


def changed(data: bytes, changes) -> bytes:
    for kind, share, value in changes:
        place = int(share * len(data))
        if kind == "set":
            data = data[:place] + value + data[place + len(value) :]
        elif kind == "insert":
            data = data[:place] + value + data[place:]
        elif kind == "repeat":
            data = data[:place] + data[max(0, place - 40) : place] + data[place:]
        elif len(data) > 20:
            data = data[:place]
    return data


@contextlib.contextmanager
def in_one_line(name=""):
    """What is refused here is refused in one line, which holds the name."""
    try:
        yield
    except TurbrestoreError as error:
        assert "\n" not in str(error) and name in str(error)


def looked_through(path):
    """Frames, or None where the file is refused in one line."""
    frames = None
    with in_one_line(path.name):
        source = open_frames(path, limits=SMALL)
        frames = list(clean_source(source, check_content(source)))
    for frame in frames or ():
        assert frame.dtype == np.float32 and frame.size <= 3 * SMALL.max_pixels
        assert frame.min() >= 0 and frame.max() <= 1
    return frames


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    for suffix in (".ser", ".npy", ".tif", ".mkv", ".mp4"):
        write_video(folder / f"a{suffix}", FRAMES, 25, 8)
    flows = np.zeros((2, 8, 10, 2), np.float32)
    save_artifact(folder / "a.npz", Centroid(FRAMES[0], flows, np.zeros(2), True))
    return folder


@pytest.mark.parametrize("suffix", [".ser", ".npy", ".tif", ".mkv", ".mp4"])
@given(changes=CHANGES)
@MANY
def test_changed_files(tmp_path, whole, suffix, changes):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(changed((whole / path.name).read_bytes(), changes))
    looked_through(path)


@given(
    colour=st.sampled_from([0, 8, 9, 11, 100, 101, 7, -1]),
    flag=st.integers(-1, 2),
    sizes=st.tuples(*[st.sampled_from([-1, 0, 1, 2, 3, 8, 200, 2**20, 2**31 - 1])] * 2),
    depth=st.integers(-1, 18),
    count=st.sampled_from([-5, 0, 1, 2, 5, 300, 2**31 - 1]),
    body=st.binary(max_size=600),
)
@settings(MANY, max_examples=200)
def test_any_ser_header(tmp_path, colour, flag, sizes, depth, count, body):
    head = b"LUCAM-RECORDER" + struct.pack("<7i", 0, colour, flag, *sizes, depth, count)
    (tmp_path / "a.ser").write_bytes(head.ljust(178, b"\0") + body)
    looked_through(tmp_path / "a.ser")


@given(data=st.binary(max_size=300), suffix=st.sampled_from([".ser", ".npy", ".tif", ".mkv", ".gif", ".avi", ".mp4"]))
@settings(MANY, max_examples=100)
def test_any_bytes(tmp_path, data, suffix):
    magic = {".ser": b"LUCAM-RECORDER", ".npy": b"\x93NUMPY\x01\x00", ".tif": b"II*\0\x08\0\0\0", ".gif": b"GIF89a"}
    (tmp_path / f"a{suffix}").write_bytes(magic.get(suffix, b"") + data)
    assert looked_through(tmp_path / f"a{suffix}") is None or suffix in (".ser", ".npy", ".gif")


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp", ".jpg"])
@given(changes=CHANGES)
@MANY
def test_changed_images(tmp_path, suffix, changes):
    data = cv2.imencode(suffix, np.uint8(255 * FRAMES[0]))[1].tobytes()
    (tmp_path / f"a{suffix}").write_bytes(changed(data, changes))
    try:
        image = read_image(tmp_path / f"a{suffix}", SMALL).image
    except TurbrestoreError as error:
        assert "\n" not in str(error)
    else:
        assert image.min() >= 0 and image.max() <= 1


class TestArchives:
    @given(changes=CHANGES)
    @settings(MANY, max_examples=150)
    def test_changed_archives(self, tmp_path, whole, changes):
        (tmp_path / "a.npz").write_bytes(changed((whole / "a.npz").read_bytes(), changes))
        with in_one_line():
            assert sum(array.nbytes for array in read_npz(tmp_path / "a.npz", SMALL).values()) <= SMALL.max_bytes

    @given(
        text=st.text(st.sampled_from("(){}[]',:0123456789-<>|ufOVdescrfortran_orderTrueFalseshape \n"), max_size=120)
    )
    @settings(MANY, max_examples=200)
    def test_any_header_of_an_array(self, tmp_path, text):
        header = text.encode() + b"\n"
        data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(64)
        (tmp_path / "a.npy").write_bytes(data)
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            archive.writestr("a.npy", data)
        for read in (map_npy, read_npz):
            with warnings.catch_warnings():
                # NumPy warns of headers as Python 2 wrote them.
                warnings.simplefilter("ignore", UserWarning)
                with in_one_line():
                    read(tmp_path / ("a.npy" if read is map_npy else "a.npz"))

    @given(
        header=st.recursive(
            st.none() | st.booleans() | st.floats() | st.text(max_size=8) | st.sampled_from([*KINDS, 1]),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(
                    st.sampled_from(
                        ["kind", "schema", "fields", "converged", "image", "flows", "mean_flow_sizes", "low", "high"]
                    ),
                    inner,
                    max_size=4,
                )
            ),
            max_leaves=8,
        ),
        kept=st.sets(st.sampled_from(["image", "flows", "mean_flow_sizes"])),
        kind=st.sampled_from(list(KINDS.values())),
    )
    @settings(MANY, max_examples=150)
    def test_any_header_of_an_artifact(self, tmp_path, header, kept, kind):
        arrays = {name: np.zeros(3) for name in kept}
        np.savez(tmp_path / "a.npz", allow_pickle=False, header=np.array(json.dumps(header)), **arrays)
        with in_one_line("a.npz"):
            load_artifact(tmp_path / "a.npz", kind)


# Values at the edge of what floating point holds, and ordinary ones.
VALUES = st.sampled_from([0.0, -0.0, 1.0, -1.0, 1e-30, 1e30, -1e30, 1e300, np.nan, np.inf, -np.inf, 5e8]) | st.floats()
SCALARS = st.none() | st.booleans() | st.integers() | VALUES | st.text(max_size=4) | st.just(10**400)
ARRAYS = st.one_of(
    st.tuples(st.just("value"), VALUES, st.floats(0, 1)),
    st.tuples(st.just("scale"), st.sampled_from([-1.0, 0.0, 1e3, 1e8, 1e-20])),
    st.tuples(st.just("dtype"), st.sampled_from(["f2", "f8", ">f4", "i4", "c8", "U3", "?", "M8[s]", "u1"])),
    st.tuples(st.just("axis"), st.sampled_from(["drop", "add", "flat", "turn", "first"])),
    st.tuples(st.just("cut"), st.integers(0, 3), st.integers(-2, 2)),
)


def doctored(array, change):
    how, *rest = change
    if how == "value":
        array = array.copy()
        if array.size:
            with np.errstate(all="ignore"):
                array.flat[min(int(rest[1] * array.size), array.size - 1)] = rest[0] if array.dtype.kind == "f" else 7
        return array
    if how == "scale":
        return array * array.dtype.type(rest[0])
    if how == "dtype":
        with np.errstate(all="ignore"):
            return array.astype(rest[0])
    if how == "axis":
        ways = {"drop": np.squeeze, "add": lambda a: a[None], "flat": np.ravel, "turn": np.transpose}
        return np.ascontiguousarray(ways.get(rest[0], lambda a: a[0] if len(a) else a)(array))
    axis, count = rest[0] % array.ndim, rest[1]
    return np.take(array, range(max(array.shape[axis] + count, 0)), axis, mode="clip") if array.size else array


def use(result):
    """Do with a result what the next stage does, and draw it."""
    if isinstance(result, Centroid):
        identify(result.flows)
        filter_frames(CLIP, result.image, WHOLE["dynamics"], FAST)
        assert len(result.flows)
    elif isinstance(result, FlowDynamics):
        found = filter_frames(CLIP, CLIP[0], result, FAST)
        assert np.isfinite(found.image).all()
        assert np.isfinite(result.eigenvalues).all() and np.isfinite(result.state_covariance).all()
    elif isinstance(result, (Filtered, Deconvolution)):
        deconvolve(result.image, 1.0, DeconvolutionParams(method="wiener"))
    result_html = getattr(result, "_repr_html_", None)
    assert result_html is None or isinstance(result_html(), str)


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
@settings(MANY, max_examples=60)
# Numbers up to a billion are read; what they overflow to is told in words or is clipped.
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_doctored_artifacts_are_refused_or_can_be_used(tmp_path, kind, data):
    result = WHOLE[kind]
    field = data.draw(st.sampled_from([item.name for item in dataclasses.fields(result)]))
    value = getattr(result, field)
    changed_value = doctored(value, data.draw(ARRAYS)) if isinstance(value, np.ndarray) else data.draw(SCALARS)
    save_artifact(tmp_path / "a.npz", dataclasses.replace(result, **{field: changed_value}), overwrite=True)
    loaded = None
    with in_one_line("a.npz"):
        loaded = load_artifact(tmp_path / "a.npz", KINDS[kind])
    with in_one_line():
        use(loaded)
