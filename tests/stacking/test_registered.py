"""Registered frames are those that the restored image was made from."""

import csv
import dataclasses

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.io.astronomy.fits_output import write_fits_cube
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames
from turbrestore.pipeline import restore
from turbrestore.registration.centroid import mean_registered
from turbrestore.registration.coverage import coverage
from turbrestore.settings import RestoreParams
from turbrestore.stacking.registered import registered_frames

TO_FILTER = RestoreParams(until="filter")


@pytest.fixture(scope="module")
def source():
    return FrameSource.from_array(make_sequence(seed=4, count=12, size=64, rms=1.2).frames)


def seen_by_all(flows):
    return coverage(np.stack(flows)) == 1


def test_the_mean_of_the_registered_frames_is_the_mean_that_the_centroid_is(source):
    restoration = restore(source, TO_FILTER)
    frames = list(registered_frames(source, restoration, TO_FILTER))
    seen = seen_by_all([frame.flow for frame in frames])
    assert seen.mean() > 0.7
    mean = np.mean([frame.image for frame in frames], axis=0)
    assert np.abs(mean - restoration.centroid.image)[seen].max() < 2e-6
    assert [frame.number for frame in frames] == list(range(12))
    assert sum(frame.share for frame in frames) == pytest.approx(1)
    assert np.argmax([frame.quality for frame in frames]) == np.argmax([frame.sharpness for frame in frames])


def test_frames_beyond_the_training_lie_in_the_geometry_of_the_filtered_image(source):
    params = dataclasses.replace(TO_FILTER, train=6)
    restoration = restore(source, params)
    assert restoration.filtered.mean_flow.any()
    frames = list(registered_frames(source, restoration, params))
    flows = np.stack([frame.flow for frame in frames])
    mean = np.mean([frame.image for frame in frames], axis=0)
    seen = seen_by_all(flows)
    own = mean_registered(source.read(), flows)
    assert np.abs(mean - own)[seen].max() < 2e-6
    # In another geometry the two would differ at every edge.
    inner = np.s_[8:-8, 8:-8]
    there = np.abs(mean - restoration.filtered.image)[inner].mean()
    assert there < 0.7 * np.abs(mean - restoration.centroid.image)[inner].mean()


def test_frames_have_the_levels_of_the_clip(source):
    dim = FrameSource.from_array(0.4 + 0.1 * source.read())
    frames = list(registered_frames(dim, restore(dim, TO_FILTER), TO_FILTER))
    assert np.mean([frame.image for frame in frames]) == pytest.approx(float(dim.read().mean()), abs=1e-3)


@pytest.mark.parametrize("depth", [8, 16, 32])
@pytest.mark.parametrize("colour", [(), (3,)])
def test_a_cube_is_read_as_it_was_written(tmp_path, depth, colour):
    stack = np.random.default_rng(0).random((3, 20, 24, *colour)).astype(np.float32)
    # Both ends, so that numbers of floating point keep their scale.
    stack[0, 0, 0], stack[0, 0, 1] = 0, 1
    write_fits_cube(tmp_path / "a.fits", iter(stack), 3, depth, history=["made by a test"])
    read = open_frames(tmp_path / "a.fits").read()
    assert read.shape == stack.shape
    assert np.abs(read - stack).max() <= (1e-6 if depth == 32 else 0.51 / (2**depth - 1))


def test_the_command_writes_frames_table_and_flows(run, clip, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick = ("--centroid.iterations", "1", "--filter.inner-iterations", "1", "--quiet")
    words = ("register", clip, "out.tif", "--bit-depth", "32", "--flows", "flows.npz", "--keep", "kept", *quick)
    assert run(*words) == (0, "", "")
    frames, found = open_frames("out.tif").read(), np.load("flows.npz")
    assert found["flows"].shape == (*frames.shape, 2)
    assert mean_registered(open_frames(clip).read(), found["flows"]) == pytest.approx(frames.mean(axis=0), abs=0.05)
    rows = list(csv.DictReader((tmp_path / "out.csv").read_text().splitlines()))
    assert [int(row["frame"]) for row in rows] == found["numbers"].tolist() == list(range(len(frames)))
    assert sum(float(row["share"]) for row in rows) == pytest.approx(1, abs=1e-4)
    before = (tmp_path / "out.tif").read_bytes()
    # A run that was kept is gone on with, also by a restoration, whose blur then stays removed.
    assert run("restore", clip, "sharp.png", "--sigma", "1", "--keep", "kept", "--resume", *quick)[0] == 0
    code, _, err = run(*words, "--sigma", "1", "--resume", "--overwrite")
    assert code == 2 and "sigma" in err
    again = (*words[:-1], "--deconvolution.sigma", "1", "--resume", "--overwrite")
    code, _, err = run(*again)
    assert code == 0 and "continues after the deconvolution" in err
    assert (tmp_path / "out.tif").read_bytes() == before
    code, _, err = run("register", clip, "out.png")
    assert code == 2 and ".ser" in err
