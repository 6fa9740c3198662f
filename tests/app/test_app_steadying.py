"""Steady video in the app, without a browser."""

import shlex
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, OutputError
from turbrestore.io.video import open_frames
from turbrestore.steady.settings import SteadyParams
from turbrestore_app.folders import Folders
from turbrestore_app.restoring import Order
from turbrestore_app.steadying import SteadyOrder
from turbrestore_app.tab import Tab
from turbrestore_cli.__main__ import main
from turbrestore_cli.options import Selection
from turbrestore_cli.steady import Output

from .conftest import ended


class TestSteady:
    def test_a_camera_is_watched_until_it_is_stopped(self, tmp_path, monkeypatch):
        released = threading.Event()

        class Camera:
            def __init__(self, name):
                self.frames = 0 if name == "/dev/video0" else None

            def read(self):
                if self.frames is None:
                    return False, None
                self.frames += 1
                return True, np.full((32, 48, 3), self.frames % 200, np.uint8)

            set = get = lambda *_: 0

            def release(self):
                released.set()

        monkeypatch.setattr("cv2.VideoCapture", Camera)
        tab = Tab(Folders(tmp_path))
        watched = tab.watch("/dev/video0")
        for _ in range(600):
            if "steadied" in watched.images or watched.state != "running":
                break
            watched.join(0.1)
        seen, steadied = watched.images["camera"], watched.images["steadied"]
        assert steadied.shape == (32, 48, 3)
        assert np.abs(seen - steadied).max() < 0.05
        tab.stop()
        assert ended(watched).state == "stopped"
        assert released.wait(10)
        assert "/dev/video1: expected a camera" in ended(tab.watch("/dev/video1")).message

    def test_the_command_gives_the_same_files(self, folder, tmp_path):
        tab = Tab(Folders(folder))
        order = SteadyOrder(
            folder / "clip.mkv", tmp_path / "a.mp4", Selection(roi="0,0,64,48"), SteadyParams(camera="lock")
        )
        job = ended(tab.steady(order))
        assert (job.state, job.result, tab.steadied.video) == ("done", tab.steadied, tmp_path / "a.mp4"), job.message
        assert [bar.total for bar in job.bars.values()] == [6, 6]
        read = [open_frames(path).read() for path in (tab.steadied.film_path, folder / "clip.mkv", order.output)]
        film, clip, video = (frames if frames.ndim == 3 else frames.mean(axis=3) for frames in read)
        assert np.abs(film - np.concatenate([clip[:, :48, :64], video], axis=2)).mean() < 0.03
        command = shlex.split(order.command_line(folder / "clip.mkv", tmp_path / "b.mp4"))
        assert main([*command[1:], "--quiet"]) == 0
        for suffix in (".mp4", ".mp4.toml"):
            assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
        # A page may still play the film of the video before.
        assert (tab.ordered_video, tab.ordered) == (order, Order(order.path, order.selection))
        films = [tab.steadied.film_path]
        for _ in range(2):
            assert ended(tab.steady(replace(order, overwrite=True))).state == "done"
            films.append(tab.steadied.film_path)
        assert [film.exists() for film in films] == [False, True, True]
        assert tab.films == {film.name: film for film in films[1:]}
        with pytest.raises(OutputError, match="exists already"):
            order.check()
        with pytest.raises(ConfigurationError, match=r"ends in \.mp4"):
            replace(order, output=tmp_path / "a.mkv").check()
        tab.open(folder / "clip.mkv")
        assert (tab.ordered_video, tab.ordered) == (None, None)
        tab.close()
        assert not any(film.exists() for film in films)

    def test_a_stop_leaves_nothing(self, folder, tmp_path, held):
        tab = Tab(Folders(folder))
        job = tab.steady(SteadyOrder(folder / "clip.mkv", tmp_path / "a.mp4"))
        tab.stop()
        held.set()
        assert ended(job).state == "stopped"
        assert (tab.steadied, list(tmp_path.iterdir())) == (None, [])
        tab.close()

    def test_doubts_about_the_clip_are_in_the_verdict(self, tmp_path):
        np.save(tmp_path / "a.npy", np.random.default_rng(0).uniform(0, 1, (48, 64, 5)).astype(np.float32))
        tab = Tab(Folders(tmp_path))
        job = ended(tab.steady(SteadyOrder(tmp_path / "a.npy", tmp_path / "a.mp4")))
        assert "; check: its axes are taken for " in job.message
        tab.close()

    def test_options_are_those_of_the_command(self, folder, tmp_path):
        params = SteadyParams(camera="steady", sigma=0.8, reach=6, largest=3.5)
        selection, written = Selection(frames="0:4"), Output("hevc", 20)
        order = SteadyOrder(folder / "clip.mkv", tmp_path / "a.mp4", selection, params, written)
        flags = order.command_line(Path("clip.mkv"), Path("a.mp4")).split()[4:]
        expected = "--camera=steady --codec=hevc --crf=20 --frames=0:4 --largest=3.5 --reach=6 --sigma=0.8"
        assert " ".join(sorted(flags)) == expected
