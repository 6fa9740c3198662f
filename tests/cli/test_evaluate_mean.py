"""What a result is compared with: the truth, and the temporal mean of its clip beside it."""

import json

import numpy as np
import pytest

from turbrestore.io.images.image_files import write_image
from turbrestore.io.video import write_video
from turbrestore.metrics import compare


def test_the_mean_of_the_clip_stands_beside_the_result(run, tmp_path, sequence):
    write_video(tmp_path / "clip.npy", sequence.frames, 25)
    write_image(tmp_path / "truth.tif", sequence.scene, 32)
    write_image(tmp_path / "result.tif", sequence.frames[0], 32)
    words = ("evaluate", tmp_path / "result.tif", tmp_path / "truth.tif", "--clip", tmp_path / "clip.npy")
    code, out, _ = run(*words, "--json")
    figures = json.loads(out)
    assert code == 0
    expected = compare(np.mean(sequence.frames, axis=0, dtype=np.float64).astype(np.float32), sequence.scene)
    assert figures["temporal_mean"]["psnr"] == pytest.approx(expected.psnr, abs=1e-3)
    assert figures["psnr"] == pytest.approx(compare(sequence.frames[0], sequence.scene).psnr, abs=1e-3)
    code, out, _ = run(*words)
    rows = out.splitlines()
    assert code == 0 and rows[0].split() == ["result", "mean"]
    assert rows[1].split()[:4] == ["psnr", f"{figures['psnr']:g}", f"{figures['temporal_mean']['psnr']:g}", "dB,"]
    assert all(", higher is better" in row or ", lower is better" in row or "is best" in row for row in rows[1:])
    # Where the result is a part of the scene, so is the mean.
    part = sequence.frames.mean(axis=0)[4:-12, 10:-2]
    write_image(tmp_path / "part.tif", part, 32)
    code, out, _ = run("evaluate", tmp_path / "part.tif", *words[2:], "--json")
    figures = json.loads(out)
    assert code == 0 and figures["temporal_mean"]["psnr"] == pytest.approx(figures["psnr"], abs=1e-2)
    code, _, err = run("evaluate", tmp_path / "result.tif", "--reference", tmp_path / "truth.tif", "--clip", words[-1])
    assert code == 2 and "--clip: has no effect without a truth" in err


def test_the_truth_may_be_an_array(run, tmp_path, sequence):
    np.save(tmp_path / "truth.npy", sequence.scene)
    write_image(tmp_path / "truth.tif", sequence.scene, 32)
    write_image(tmp_path / "result.tif", sequence.frames[0], 32)
    figures = [run("evaluate", tmp_path / "result.tif", tmp_path / f"truth.{kind}")[1] for kind in ("npy", "tif")]
    assert figures[0] == figures[1] != ""
    np.save(tmp_path / "clip.npy", sequence.frames)
    code, _, err = run("evaluate", tmp_path / "result.tif", tmp_path / "clip.npy")
    assert code == 65 and "clip.npy: expected an image of shape (H, W) or (H, W, 3)" in err
