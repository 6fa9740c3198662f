"""Published data sets: a tiny folder of each layout is read as its authors read it, and scored by their metric."""

import json

import cv2
import datasets
import numpy as np
import pytest
import skimage.data
from skimage.metrics import structural_similarity

from conftest import make_sequence
from turbrestore.io.video import write_video
from turbrestore.metrics import psnr

SIDE = 40


@pytest.fixture(scope="module")
def clip():
    return make_sequence(4, 20, SIDE, "camera", rms=0.8)


def lay_out(folder, frames, form="{:d}.png", first=0):
    folder.mkdir(parents=True)
    for number, frame in enumerate(frames):
        save(folder / form.format(first + number), frame)


def save(path, image):
    """Write an image as its authors' tools do, JPEG too."""
    assert cv2.imwrite(str(path), np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 98])


def repeated(frames, count):
    return [frames[number % len(frames)] for number in range(count)]


def atsyn_static(folder, clip):
    lay_out(folder / "Places_1" / "turb", repeated(clip.frames, 50))
    lay_out(folder / "Places_1" / "tilt", clip.frames[:1])
    save(folder / "Places_1" / "gt.jpg", clip.scene)


def tmt_static(folder, clip):
    lay_out(folder / "7" / "turb", repeated(clip.frames, 50), "{:d}.jpg")
    save(folder / "7" / "gt.jpg", clip.scene)


def atsyn_dynamic(folder, clip):
    for kind, frames in (("turb", clip.frames), ("gt", np.repeat(clip.scene[None], len(clip.frames), axis=0))):
        (folder / kind).mkdir()
        for name in ("a.mp4", "b.mp4"):
            write_video(folder / kind / name, frames, fps=25)
    levels = ("a.mp4", "weak"), ("b.mp4", "strong")
    entries = {str(n): {"video_name": name, "turb_level": level} for n, (name, level) in enumerate(levels)}
    (folder / "test_info.json").write_text(json.dumps({"num_videos": 2, **entries}))


def turbulence_text(folder, clip):
    lay_out(folder / "1", repeated(clip.frames, 100), "data_{:04d}.png", first=1)


def otis(folder, clip):
    lay_out(folder / "Fixed Patterns" / "Pattern1", clip.frames, "Pattern1_{:03d}.png")
    lay_out(folder / "Fixed Patterns" / "Pattern1" / "GT", [clip.scene], "Pattern1_GT.png")


def heat_chamber(folder, clip):
    lay_out(folder / "scene_0001" / "turb", clip.frames)
    save(folder / "scene_0001" / "gt.png", clip.scene)


def rlr_at(folder, clip):
    lay_out(folder / "Building", clip.frames, first=1)


def clear(folder, clip):
    write_video(folder / "van.mp4", clip.frames, fps=25)


LAYOUTS = {
    "atsyn-static": atsyn_static,
    "atsyn-dynamic": atsyn_dynamic,
    "tmt-static": tmt_static,
    "turbulence-text": turbulence_text,
    "otis": otis,
    "heat-chamber": heat_chamber,
    "rlr-at": rlr_at,
    "clear": clear,
}
# Frames that are restored together.
WINDOWS = {"atsyn-static": [20], "tmt-static": [12] * 4, "turbulence-text": [60]}
WITHOUT_TRUTH = {"turbulence-text", "rlr-at", "clear"}


@pytest.mark.parametrize("name", LAYOUTS)
class TestLayout:
    def test_sequences_are_found_and_scored(self, name, clip, tmp_path):
        LAYOUTS[name](tmp_path, clip)
        figures = datasets.score_folder(name, tmp_path, limit=1)
        assert "mean" in figures
        assert len(figures) >= 2
        expected = {"sharpness", "overshoot"} if name in WITHOUT_TRUTH else {"psnr", "ssim"}
        assert set(figures["mean"]) == expected
        if "psnr" in expected:
            truth, mean = clip.scene, clip.frames.mean(axis=0)
            assert figures["mean"]["psnr"] > psnr(mean, truth)

    def test_windows_are_those_of_the_authors(self, name, clip, tmp_path):
        LAYOUTS[name](tmp_path, clip)
        sample = next(datasets.DATASETS[name](tmp_path))
        windows = [*sample.windows()]
        assert [len(window) for window in windows] == WINDOWS.get(name, [len(clip.frames)])
        if name == "atsyn-static":
            np.testing.assert_allclose(windows[0][0], clip.frames[15], atol=0.01)
        if name == "turbulence-text":
            np.testing.assert_allclose(windows[0][0], clip.frames[20 % len(clip.frames)], atol=0.01)

    def test_a_folder_without_the_layout_is_refused(self, name, clip, tmp_path, capsys):
        assert datasets.main([name, str(tmp_path)]) == 65
        assert name in capsys.readouterr().err
        assert datasets.main([name, str(tmp_path / "none")]) == 66


def test_the_ends_of_a_video_do_not_count(clip, tmp_path):
    truth = np.repeat(clip.scene[None], 8, axis=0)
    spoilt = truth.copy()
    spoilt[[0, 1, 6, 7]] = 0
    figures = [
        datasets.score(datasets.Sample("a", lambda: iter([truth]), lambda known=known: known, video=True))
        for known in (truth, spoilt)
    ]
    assert figures[0] == figures[1]


def test_results_are_written_for_the_recognisers_of_others(clip, tmp_path):
    turbulence_text(tmp_path / "in", clip)
    datasets.score_folder("turbulence-text", tmp_path / "in", out=tmp_path / "out")
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.glob("out/*/*")] == ["out/1/result_0001.png"]
    result = tmp_path / "out/1/result_0001.png"
    result.write_bytes(b"mine")
    with pytest.raises(datasets.OutputError, match="exists already"):
        datasets.score_folder("turbulence-text", tmp_path / "in", out=tmp_path / "out")
    assert result.read_bytes() == b"mine"


@pytest.mark.parametrize("channels", [1, 3])
def test_structural_similarity_is_that_of_a_gaussian_window(channels):
    truth = skimage.data.astronaut()[:90, :110].astype(np.float64) / 255
    truth = truth if channels == 3 else truth[..., 0]
    image = np.clip(truth + np.random.default_rng(0).normal(0, 0.1, truth.shape), 0, 1)
    # Scikit-image cuts the same border off; its window is 11 pixels wide for this σ.
    expected = structural_similarity(
        image, truth, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        channel_axis=-1 if channels == 3 else None,
    )  # fmt: skip
    assert datasets.ssim(image, truth) == pytest.approx(expected, abs=1e-6)
