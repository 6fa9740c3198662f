"""The sample clip is the one in ``sample_data``, so that whoever has no clone has the same."""

from pathlib import Path

import numpy as np

from turbrestore.io.images.image_files import read_image
from turbrestore.io.video import open_frames

STORED = Path(__file__).parents[2] / "sample_data"


def test_the_sample_is_that_of_the_repository(run, tmp_path):
    folder = tmp_path / "sample_data"
    assert run("sample", folder)[0] == 0
    made, stored = (open_frames(place / "chart.mkv") for place in (folder, STORED))
    assert made.fps == stored.fps
    # Other versions of the libraries round differently here and there.
    change = np.abs(made.read() - stored.read())
    assert change.max() < 1.01 / 255 and change.mean() < 1e-3 / 255
    truths = (read_image(place / "chart_truth.png").image for place in (folder, STORED))
    np.testing.assert_array_equal(*truths)


def test_nothing_is_replaced_unless_asked(run, tmp_path):
    (tmp_path / "chart_truth.png").write_text("mine")
    code, _, err = run("sample", tmp_path)
    assert code == 73 and "chart_truth.png" in err and "--overwrite" in err
    assert (tmp_path / "chart_truth.png").read_text() == "mine" and not (tmp_path / "chart.mkv").exists()
    assert run("sample", tmp_path, "--overwrite")[0] == 0
