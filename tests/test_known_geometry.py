"""Clips in one geometry: results on a reference, and flows of another recording."""

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.video import write_video
from turbrestore.known_geometry import settings_of_known_flows
from turbrestore.pipeline import restore
from turbrestore.registration.flow import estimate_flow
from turbrestore.runs.run_files import load_run
from turbrestore.settings import RestoreParams
from turbrestore.synthesis.drawn_scenes import street
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

SIZE, COUNT = 128, 16
QUICK = ("--deconvolution.iterations", "5", "--sigma", "0.8", "--quiet")


def channels():
    """Red, green and blue of one scene: edges side by side change their contrast by different factors."""
    return dict(zip(("red", "green", "blue"), np.moveaxis(street(SIZE, SIZE), -1, 0).copy(), strict=True))


def recording(scene, seed, offset=(0.0, 0.0)):
    rng = np.random.default_rng(seed)
    # Flows of a clip average to a geometry of its own, as those of few frames do.
    flows = smooth_flows(COUNT, SIZE, SIZE, rng, SmoothFlowParams(rms=1.0, correlation_length=14, persistence=0.2))
    flows += np.float32(offset)
    return distort(scene, flows, rng, blur=0.8, noise=0.005), flows


def geometry(result, scene):
    """Where a result shows the points of its true scene, averaged over a few pixels as the air bends it."""
    flow = estimate_flow(cv2.GaussianBlur(scene, (0, 0), 1), cv2.GaussianBlur(result, (0, 0), 1)[None])[0]
    return cv2.GaussianBlur(flow, (0, 0), 3)[10:-10, 10:-10]


def distance(a, b):
    return float(np.median(np.linalg.norm(a - b, axis=-1)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Clips of three filters, one after the other, while the telescope drifts; and green with a second camera."""
    folder = tmp_path_factory.mktemp("filters")
    drifts = {"red": (0.0, 0.0), "green": (1.5, -1.0), "blue": (-2.5, 2.0)}
    for seed, (name, scene) in enumerate(channels().items()):
        write_video(folder / f"{name}.npy", recording(scene, seed, drifts[name])[0], 25, 32)
    write_video(folder / "second.npy", recording(channels()["blue"], 1, drifts["green"])[0], 25, 32)
    return folder


def command(run, folder, *words):
    code, _, err = run(*words, *QUICK)
    assert code == 0, err
    return read_image(folder / words[2]).image


def test_three_channels_on_one_reference_have_its_geometry(run, folder, monkeypatch):
    monkeypatch.chdir(folder)
    alone = {
        name: command(run, folder, "restore", f"{name}.npy", f"{name}.tif", "--train", "16", *more)
        for name, more in {"red": ("--keep", "run"), "green": (), "blue": ()}.items()
    }
    onto = {"green": "red.tif", "blue": "run"}
    placed = {
        name: command(run, folder, "restore", f"{name}.npy", f"{name}_r.tif", "--reference", onto[name])
        for name in onto
    }
    placed["red"] = alone["red"]
    before, after = (
        {name: geometry(images[name], scene) for name, scene in channels().items()} for images in (alone, placed)
    )
    for first, second in (("red", "green"), ("red", "blue"), ("green", "blue")):
        assert distance(before[first], before[second]) > 1.2
        assert distance(after[first], after[second]) <= 0.1


def test_flows_of_another_recording_are_applied_as_they_are(run, folder, monkeypatch):
    monkeypatch.chdir(folder)
    green = command(run, folder, "restore", "green.npy", "g.tif", "--keep", "green")
    second = command(run, folder, "restore", "second.npy", "s.tif", "--like", "green", "--keep", "second")
    first, other = load_run("green")[0], load_run("second")[0]
    assert (other.centroid.flows == first.centroid.flows).all()
    assert not other.filtered.mean_flow.any()
    scenes = channels()
    assert distance(geometry(green, scenes["green"]), geometry(second, scenes["blue"])) <= 0.05
    # Flows of frames that the run has not trained on are in the file that register writes.
    assert (
        run("register", "green.npy", "g.npy", "--train", "8", "--keep", "part", "--flows", "f.npz", "--quiet")[0] == 0
    )
    code, _, err = run("restore", "second.npy", "p.tif", "--like", "part", *QUICK)
    assert (code, "register CLIP OUT --keep part --resume --flows" in err) == (65, True)
    part = command(run, folder, "restore", "second.npy", "p.tif", "--like", "f.npz")
    assert distance(geometry(part, scenes["blue"]), geometry(np.load("g.npy").mean(axis=0), scenes["green"])) <= 0.09
    code, _, err = run("restore", "second.npy", "q.tif", "--like", "f.npz", "--frames", "0:10", *QUICK)
    assert code == 0, err


def test_what_cannot_be_placed_is_refused(folder):
    with pytest.raises(ConfigurationError, match="contradicts reference"):
        RestoreParams(reference="a.png", like="b.npz")
    params = RestoreParams(like="b.npz", train=4)
    assert settings_of_known_flows(params, 9).train == 9
    frames = np.load(folder / "red.npy")
    noise = np.random.default_rng(0).random((SIZE, SIZE)).astype(np.float32)
    write_image(folder / "noise.tif", noise, 32)
    write_image(folder / "small.tif", noise[:64], 32)
    for name, match in (("noise.tif", "expected the scene of the reference"), ("small.tif", "turbrestore align")):
        with pytest.raises(DataError, match=match):
            restore(frames, RestoreParams(until="centroid", reference=str(folder / name)))
