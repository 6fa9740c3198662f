"""Whether the input of a run has changed."""

import os
import shutil
from pathlib import Path

import numpy as np

from turbrestore.io.video import open_frames
from turbrestore.runs.digests import content_digest


class TestContent:
    def test_copies_are_equal_and_changes_are_seen(self, tmp_path):
        frames = np.random.default_rng(0).uniform(size=(4, 16, 16)).astype(np.float32)
        np.save(tmp_path / "a.npy", frames)
        shutil.copy(tmp_path / "a.npy", tmp_path / "b.npy")
        frames[3, 15, 15] += 1e-6
        np.save(tmp_path / "c.npy", frames)
        first, copy, changed = (content_digest(open_frames(tmp_path / f"{name}.npy")) for name in "abc")
        assert first == copy != changed

    def test_of_a_folder_names_and_images_count(self, tmp_path):
        folder = tmp_path / "frames"
        folder.mkdir()
        for name in "ab":
            shutil.copy(Path(__file__).parents[2] / "sample_data" / "chart_truth.png", folder / f"{name}.png")
        before = content_digest(open_frames(folder))
        (folder / "notes.txt").write_text("no image")
        assert content_digest(open_frames(folder)) == before
        (folder / "b.png").rename(folder / "c.png")
        assert content_digest(open_frames(folder)) != before

    def test_a_huge_file_is_sampled(self, tmp_path, monkeypatch):
        monkeypatch.setattr("turbrestore.runs.digests._WHOLE", 1000)
        path = tmp_path / "a.npy"
        np.save(path, np.zeros((100, 64, 64), np.float32))
        source = open_frames(path)
        before = content_digest(source)
        assert content_digest(source) == before
        with path.open("r+b") as file:
            file.seek(800_000)
            file.write(b"\1")
        os.utime(path, (1, 1))
        assert content_digest(source) != before
