"""A clip that uses a part of the scale: stages work and are kept at levels of their own, and give back the clip's."""

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.filtering.alternating import Filtered
from turbrestore.io.npy import read_npz
from turbrestore.io.source import FrameSource
from turbrestore.pipeline import restore
from turbrestore.registration.centroid import Centroid
from turbrestore.runs.run_files import load_run, save_run
from turbrestore.runs.run_record import RunRecord
from turbrestore.runs.stage_files import load_artifact, load_stage_image
from turbrestore_cli.__main__ import main

from .conftest import OFTEN, SETTINGS, interrupt, params_of

LOW, SPAN = 0.3, 0.05
WORDS = ["restore", "clip.npy", "sharp.tif", OFTEN, "--scale=1.5", *SETTINGS]


@pytest.fixture
def clip(tmp_path, monkeypatch):
    frames = make_sequence(seed=41, count=28, size=32, scene="camera", rms=0.6).frames
    monkeypatch.chdir(tmp_path)
    np.save("clip.npy", np.round(65535 * (LOW + SPAN * frames)).astype(np.uint16))
    return np.load("clip.npy")


def test_a_resumed_run_of_a_stretched_clip_ends_with_the_same_bytes(clip, tmp_path):
    assert main(WORDS) == 0
    expected = (tmp_path / "sharp.tif").read_bytes()
    for where, call in (
        ("turbrestore.filtering.alternating.pass_over", 4),
        ("turbrestore.pipeline.remove_blur_steps", 1),
        ("turbrestore_cli.clip.write_result", 1),
    ):
        words = [*WORDS, f"--keep=kept{where[-5:]}", "--overwrite"]
        with pytest.MonkeyPatch.context() as patch:
            interrupt(patch, where, call)
            assert main(words) == 130
        assert main([*words, "--resume"]) == 0
        assert (tmp_path / "sharp.tif").read_bytes() == expected


def test_what_is_kept_is_read_at_the_levels_of_the_clip(clip, tmp_path):
    assert main([*WORDS, "--keep=kept"]) == 0
    found, run = load_run("kept")
    usual = restore(FrameSource.from_array(clip), params_of(WORDS))
    kept = read_npz(tmp_path / "kept" / "filtered.npz")
    gain = np.ptp(kept["image"]) / np.ptp(found.filtered.image)
    assert gain > 5
    np.testing.assert_allclose(kept["variance"], gain**2 * found.filtered.variance, rtol=1e-4)
    for stage, names in {
        "centroid": ("image",),
        "filtered": ("image", "variance", "image_noise"),
        "deconvolution": ("image", "noise"),
        "blur": ("noise",),
    }.items():
        for name in names:
            assert np.array_equal(getattr(getattr(found, stage), name), getattr(getattr(usual, stage), name)), name
    for name in ("image", "mean", "uncertainty"):
        assert np.array_equal(getattr(found, name), getattr(usual, name)), name
    for image in (found.image, usual.finer, load_stage_image("kept/centroid.npz"), found.centroid.image):
        assert abs(image.mean() - clip.mean() / 65535) < 0.02 * SPAN
    assert np.array_equal(load_artifact("kept/filtered.npz", Filtered).image, usual.filtered.image)
    assert main(["deconvolve", "kept/filtered.npz", "again.npz", "--sigma=0"]) == 0
    np.testing.assert_allclose(load_stage_image("again.npz"), usual.filtered.image, atol=1e-6)
    # What is saved from a restoration has the levels of the clip in its files too.
    save_run("saved", usual, RunRecord("saved", run.frame))
    assert np.array_equal(read_npz(tmp_path / "saved" / "centroid.npz")["image"], usual.centroid.image)
    assert np.array_equal(load_artifact("saved/centroid.npz", Centroid).image, usual.centroid.image)


def test_values_beyond_the_range_of_the_scene_are_not_lost_before_the_image(clip):
    clip[:, 10, 10] = 65535
    found = restore(FrameSource.from_array(clip), params_of([*WORDS, "--deconvolution.sigma=0.6"]))
    assert found.centroid.image[10, 10] > 0.6
    # The deconvolution makes a lone bright pixel brighter.
    assert found.deconvolution.image[10, 10] > found.filtered.image[10, 10] > 0.6
    # A lone bright pixel is no reason to call the clip saturated.
    assert "saturation" not in {decision.subject for decision in found.decisions}
