"""``turbrestore synthesize`` on real files: what it writes, what repeats, how it ends."""

import json
from contextlib import nullcontext
from functools import partial

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore import __version__
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.video import open_frames, write_video
from turbrestore.metrics import psnr
from turbrestore.registration.warp import warp
from turbrestore.runs.stage_files import load_flows
from turbrestore.synthesis.atmosphere import fried_parameter
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore_cli.progress import TITLES

# Small and cheap to draw.
QUICK = ["--size", "80x64", "--layers", "2", "--pupil-samples", "24", "--frames", "3", "--quiet"]


@pytest.fixture
def run(run):
    return partial(run, "synthesize")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clip") / "haze.mkv"
    write_video(path, make_sequence(seed=41, count=14, size=64, rms=1.0).frames, 25)
    return path


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_phase_screens_write_video_truth_flow_and_parameters(run, tmp_path):
    output = tmp_path / "haze.mkv"
    code, out, err = run("chart", output, *QUICK, "--strength", "weak", "--seed", "3", "--frame-rate", "50", "--json")
    assert code == 0, err
    sides = {"haze.truth.png", "haze.truth_diffraction.png", "haze.flow.npy", "haze.json"}
    assert names(tmp_path) == {"haze.mkv", *sides}
    video = open_frames(output)
    assert (video.shape, video.fps, video.bit_depth) == ((3, 64, 80), 50.0, 8)
    truth = cv2.imread(str(tmp_path / "haze.truth.png"), cv2.IMREAD_UNCHANGED)
    assert truth.dtype == np.uint16
    assert truth / 65535 == pytest.approx(resolution_chart(64, 80), abs=1e-4)
    flows = load_flows(tmp_path / "haze.flow.npy")
    assert flows.shape == (3, 64, 80, 2)
    sharp = read_image(tmp_path / "haze.truth_diffraction.png").image
    inside = (slice(10, -10), slice(10, -10))
    for frame, flow in zip(video, flows, strict=True):
        assert psnr(warp(frame, flow)[inside], sharp[inside]) > psnr(frame[inside], sharp[inside]) + 1
    record = json.loads((tmp_path / "haze.json").read_text())
    assert (record["turbrestore"], record["seed"], record["scene"]) == (__version__, 3, "chart")
    assert record["derived"]["d_over_r0"] == pytest.approx(1.2)
    assert record["derived"]["r0"] == pytest.approx(0.1 / 1.2)
    assert record["path"]["layers"] == len(record["derived"]["layers"]) == 2
    assert record["camera"]["frame_rate"] == 50
    assert record["flow_rms"] == pytest.approx(np.sqrt(np.mean(flows**2, axis=(0, 1, 2))), rel=1e-4)
    printed = json.loads(out)
    assert printed.pop("output") == str(output)
    assert printed == record


def test_moving_objects_have_a_truth_and_a_mask_for_every_frame(run, tmp_path):
    output = tmp_path / "a.mkv"
    assert run("chart", output, *QUICK, "--moving", "2")[0] == 0
    sides = {"a.truth.png", "a.truth_diffraction.png", "a.flow.npy", "a.json", "a.truth.mkv", "a.mask.mkv"}
    assert names(tmp_path) == {"a.mkv", *sides}
    truth, mask = (open_frames(tmp_path / f"a.{ending}.mkv").read() for ending in ("truth", "mask"))
    background = read_image(tmp_path / "a.truth.png").image
    assert truth.shape == mask.shape == (3, 64, 80)
    assert set(np.unique(mask)) == {0.0, 1.0}
    for frame, moving in zip(truth, mask, strict=True):
        beyond = cv2.dilate(moving, np.ones((3, 3))) == 0
        assert np.allclose(frame[beyond], background[beyond], atol=1e-4)
        assert np.abs(frame - background)[moving > 0].mean() > 0.05
    assert len(json.loads((tmp_path / "a.json").read_text())["objects"]) == 2
    assert run("chart", output, *QUICK, "--overwrite")[0] == 0
    assert names(tmp_path) == {"a.mkv", *sides} - {"a.truth.mkv", "a.mask.mkv"}


@pytest.mark.parametrize("suffix", ["npy", "mkv"])
def test_the_same_seed_writes_the_same_bytes(run, tmp_path, suffix):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        assert run("chart", tmp_path / f"{name}.{suffix}", *QUICK, "--seed", seed)[0] == 0
    for ending in (suffix, "flow.npy", "json", "truth.png", "truth_diffraction.png"):
        first, again, other = ((tmp_path / f"{name}.{ending}").read_bytes() for name in "abc")
        assert first == again
        assert (first == other) == ending.startswith("truth")


def test_explicit_numbers_reach_the_path_and_the_camera(run, tmp_path):
    numbers = ["--cn2", "2e-15", "--distance", "1500", "--aperture", "0.08", "--outer-scale", "3", "--wind", "1",
               "--wind", "2", "--wind-direction", "45", "--exposure", "0.02", "--sub-frames", "2", "--photons", "inf",
               "--read-noise", "0", "--bit-depth", "12", "--nyquist", "0.8"]  # fmt: skip
    code, _, err = run("chart", tmp_path / "a.npy", *QUICK, *numbers)
    assert code == 0, err
    record = json.loads((tmp_path / "a.json").read_text())
    assert record["derived"]["r0"] == pytest.approx(fried_parameter(2e-15, 1500, 550e-9))
    assert record["derived"]["ifov"] == pytest.approx(550e-9 / 0.16 / 0.8)
    speeds = [np.hypot(*layer["velocity"]) for layer in record["derived"]["layers"]]
    assert speeds == pytest.approx([1.0, 2.0])
    assert record["camera"] == {"frame_rate": 30.0, "exposure": 0.02, "sub_frames": 2, "photons": None,
                                "read_noise": 0.0, "bit_depth": 12}  # fmt: skip
    assert open_frames(tmp_path / "a.npy").bit_depth == 16


def test_colour_picture_of_the_users_own(run, tmp_path):
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.random((48, 64, 3), dtype=np.float32), (0, 0), 2.0)
    picture = (picture - picture.min()) / np.ptp(picture)
    write_image(tmp_path / "own.png", picture, 8)
    code, _, err = run(
        tmp_path / "own.png", tmp_path / "o.mkv", "--layers", "2", "--pupil-samples", "24", "--frames", 1
    )
    assert code == 0, err
    assert "1 frame, " in err
    assert open_frames(tmp_path / "o.mkv").shape == (1, 48, 64, 3)
    assert read_image(tmp_path / "o.truth.png").image == pytest.approx(picture, abs=1 / 250)


@pytest.mark.parametrize("exposure", [[], ["--exposure", "0.03", "--sub-frames", "3"]])
def test_dynamic_texture_continues_a_clip(run, clip, tmp_path, exposure):
    words = ["--model", "dynamic-texture", "--like", clip, "--frames", "20", "--quiet"]
    words += ["--dynamic-texture.fit", "mirror"]
    code, _, err = run("chart", tmp_path / "t.mkv", *words, "--size", "96x72", *exposure, "--read-noise", "0.002")
    assert code == 0, err
    assert names(tmp_path) == {"t.mkv", "t.truth.png", "t.flow.npy", "t.json"}
    video, flows = open_frames(tmp_path / "t.mkv").read(), load_flows(tmp_path / "t.flow.npy")
    assert video.shape == (20, 72, 96)
    truth = read_image(tmp_path / "t.truth.png").image
    inside = (slice(10, -10), slice(10, -10))
    back = np.mean([warp(frame, flow) for frame, flow in zip(video, flows, strict=True)], axis=0)
    assert psnr(back[inside], truth[inside]) > psnr(video.mean(axis=0)[inside], truth[inside]) + 2
    assert json.loads((tmp_path / "t.json").read_text())["derived"]["states"] > 0


def test_dynamic_texture_of_the_centroid(run, clip, tmp_path):
    words = ["--model", "dynamic-texture", "--like", clip, "--frames", "4", "--quiet"]
    assert run("centroid", tmp_path / "a.npy", *words)[0] == 0
    assert run("centroid", tmp_path / "b.npy", *words)[0] == 0
    assert read_image(tmp_path / "a.truth.png").image.shape == (64, 64)
    for ending in ("npy", "flow.npy"):
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


def test_progress_counts_the_flows_of_the_clip_and_the_frames(run, clip, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(
        "turbrestore_cli.synthesis.progress_bars", lambda *_: nullcontext(lambda *call: calls.append(call))
    )
    assert run("chart", tmp_path / "a.npy", *QUICK)[0] == 0
    assert calls == [("synthesize", done, 3) for done in (1, 2, 3)]
    calls.clear()
    words = ["--model", "dynamic-texture", "--like", clip, "--frames", "2"]
    words += ["--dynamic-texture.centroid.iterations", "1"]
    assert run("centroid", tmp_path / "b.npy", *words)[0] == 0
    assert calls == [("centroid", k, 14) for k in range(1, 15)] + [("synthesize", k, 2) for k in (1, 2)]
    assert {stage for stage, *_ in calls} <= set(TITLES)


def test_overwriting_is_explicit_and_leaves_nothing_of_before(run, clip, tmp_path):
    assert run("chart", tmp_path / "a.mkv", *QUICK)[0] == 0
    before = (tmp_path / "a.mkv").read_bytes()
    code, _, err = run("chart", tmp_path / "a.mkv", *QUICK, "--seed", "1")
    assert code == 73
    assert "exists already" in err
    assert (tmp_path / "a.mkv").read_bytes() == before
    (tmp_path / "a.mkv").unlink()
    assert run("chart", tmp_path / "a.mkv", *QUICK)[0] == 73
    texture = ["--model", "dynamic-texture", "--like", clip, "--frames", "2", "--quiet", "--overwrite"]
    assert run("chart", tmp_path / "a.mkv", *texture)[0] == 0
    assert names(tmp_path) == {"a.mkv", "a.truth.png", "a.flow.npy", "a.json"}


@pytest.mark.parametrize(
    "when", ["turbrestore_cli.synthesis.write_image", "turbrestore.synthesis.anisoplanatic.record"]
)
@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (OSError(28, "No space left"), 74)])
def test_failure_half_way_leaves_nothing(run, tmp_path, monkeypatch, when, error, code):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(when, fail)
    assert run("chart", tmp_path / "a.mkv", *QUICK)[0] == code
    assert names(tmp_path) == set()


def plain(folder):
    write_image(folder / "plain.png", np.full((64, 64), 0.5, np.float32), 8)
    return folder / "plain.png"


def pixel(folder):
    write_image(folder / "pixel.png", np.zeros((1, 1), np.float32), 8)
    return folder / "pixel.png"


@pytest.mark.parametrize(
    ("scene", "words", "code", "part"),
    [
        ("chart", ["--cn2", "-1e-15"], 2, "cn2: expected a positive number"),
        ("chart", ["--aperture", "0"], 2, "aperture"),
        ("chart", ["--exposure", "0.05"], 2, "exposure: expected 0 to the frame time"),
        ("chart", ["--strength", "weak", "--r0", "0.05"], 2, "--strength: contradicts --r0"),
        ("chart", ["--wind", "1", "--wind", "2"], 2, "wind: expected one value"),
        ("chart", ["--frames", "1000000000"], 2, "--frames"),
        ("chart", ["--size", "8x8"], 2, "at least 64"),
        ("chart", ["--size", "99999x99999"], 2, "--size: expected at most"),
        ("chart", ["--dynamic-texture.fit", "stretch"], 2, "--dynamic-texture: has no effect"),
        ("chart", ["--like", "clip.mkv"], 2, "--like, --train: have no effect"),
        ("chart", ["--model", "dynamic-texture"], 2, "--like: expected a video"),
        ("chart", ["--model", "dynamic-texture", "--like", "none.mkv"], 66, "none.mkv"),
        ("chart", ["--model", "dynamic-texture", "--like", "none.mkv", "--strength", "weak"], 2, "--strength"),
        ("chart", ["--model", "dynamic-texture", "--like", "none.mkv", "--wind", "3"], 2, "no path"),
        ("chart", ["--train", "5"], 2, "--train"),
        ("chart", ["--model", "dynamic-texture", "--like", "none.mkv", "--train", "2"], 2, "--train: expected 3"),
        ("centroid", [], 2, "--like"),
        ("centroid", ["--model", "dynamic-texture", "--like", "none.mkv", "--size", "64x64"], 2, "--size: has no"),
        ("chrat", [], 2, "chrat: expected an image file or one of"),
        ("none.png", [], 66, "none.png"),
        (plain, [], 65, "one colour"),
        (pixel, [], 65, "16×16 pixels, found 1×1"),
        (plain, ["--size", "64x64"], 2, "--size: has no effect"),
    ],
)
def test_bad_requests_are_one_line_and_leave_nothing(run, tmp_path, scene, words, code, part):
    folder = tmp_path / "out"
    folder.mkdir()
    found, out, err = run(scene(tmp_path) if callable(scene) else scene, folder / "a.mkv", *words)
    assert found == code, err
    assert out == ""
    assert err.startswith("turbrestore: ")
    assert err.count("\n") == 1
    assert part in err
    assert names(folder) == set()


def test_outputs_that_cannot_be(run, tmp_path, monkeypatch):
    assert run("chart", tmp_path / "a.xyz")[0] == 2
    assert run("chart", "")[0] == 2
    assert run("chart", tmp_path / "none" / "a.mkv")[0] == 73
    (tmp_path / "b.json").mkdir()
    assert run("chart", tmp_path / "b.mkv", "--overwrite")[0] == 73

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    # A folder may be writable by its mode and still refuse, as read-only file systems do.
    with monkeypatch.context() as patch:
        patch.setattr("turbrestore_cli.synthesis.tempfile.TemporaryDirectory", refuse)
        code, _, err = run("chart", tmp_path / "c.mkv", *QUICK)
    assert (code, err.count("\n")) == (73, 1)
    assert "c.mkv: cannot be created (Permission denied)" in err
    write_image(tmp_path / "a.truth.png", resolution_chart(64, 64), 16)
    code, _, err = run(tmp_path / "a.truth.png", tmp_path / "a.mkv", "--overwrite")
    assert code == 73
    assert "is the input" in err
