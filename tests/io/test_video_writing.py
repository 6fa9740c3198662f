"""Videos out."""

import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, DataError, OutputError
from turbrestore.io.video import open_frames, write_video
from videos import scene


class TestWriting:
    @pytest.mark.parametrize(("depth", "written"), [(1, 8), (9, 10), (11, 12), (15, 16), (32, 16)])
    def test_other_depths_go_to_the_next_that_mkv_has(self, tmp_path, depth, written):
        write_video(tmp_path / "a.mkv", np.ones((2, 3, 4), np.float32), 25, bit_depth=depth)
        source = open_frames(tmp_path / "a.mkv")
        assert source.bit_depth == written and source.read().min() == 1

    def test_npy_is_what_numpy_reads(self, tmp_path):
        stack = np.random.default_rng(0).random((123, 2, 3), dtype=np.float32)
        write_video(tmp_path / "a.npy", iter(stack), 25, bit_depth=32)
        np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), stack)

    @pytest.mark.parametrize("shape", [(48, 64), (47, 63), (48, 64, 3)])
    def test_mp4_is_close(self, tmp_path, shape):
        frames = [(frame[: shape[0], : shape[1]] / np.float32(255)) for frame in scene()]
        frames = [frame if len(shape) == 3 else frame[..., 0] for frame in frames]
        write_video(tmp_path / "a.mp4", frames, 25)
        found = open_frames(tmp_path / "a.mp4").read()
        expected = np.stack(frames) if len(shape) == 3 else np.stack(frames)[..., None]
        assert np.mean(np.abs(found - expected)) < 0.02

    @pytest.mark.parametrize("name", ["a.mkv", "a.npy", "a.tif", "a.ser"])
    @pytest.mark.parametrize("shape", [(5, 16, 20), (5, 16, 20, 3)])
    def test_the_same_frames_give_the_same_bytes(self, tmp_path, name, shape):
        stack = np.random.default_rng(0).random(shape, dtype=np.float32)
        written = []
        for frames in (stack, stack, 1 - stack):
            write_video(tmp_path / name, frames, 25, overwrite=True)
            written.append((tmp_path / name).read_bytes())
        assert written[0] == written[1] != written[2]

    def test_a_source_can_be_written(self, tmp_path):
        write_video(tmp_path / "a.mkv", np.full((4, 5, 6), 0.2, np.float32), 25)
        source = open_frames(tmp_path / "a.mkv", frames=(1, 3))
        write_video(tmp_path / "b.mkv", source, 25)
        np.testing.assert_array_equal(open_frames(tmp_path / "b.mkv").read(), source.read())

    def test_broadcast_rates_survive(self, tmp_path):
        write_video(tmp_path / "a.mkv", np.zeros((3, 4, 5), np.float32), 30000 / 1001)
        assert open_frames(tmp_path / "a.mkv").fps == pytest.approx(30000 / 1001, rel=1e-9)

    @pytest.mark.parametrize("fps", [0, -1, float("nan"), float("inf"), 2000])
    def test_impossible_rates_are_usage_errors(self, tmp_path, fps):
        with pytest.raises(ConfigurationError, match="fps"):
            write_video(tmp_path / "a.mkv", np.zeros((3, 4, 5), np.float32), fps)
        assert not any(tmp_path.iterdir())

    @pytest.mark.parametrize("name", ["a.mkv", "a.mp4", "a.npy", "a.tif", "a.ser"])
    def test_failures_leave_nothing_behind(self, tmp_path, name):
        good = np.zeros((8, 8), np.float32)

        def interrupted():
            yield good
            raise KeyboardInterrupt

        cases = [
            ([], DataError),
            ([good, np.zeros((8, 10), np.float32)], DataError),
            ([good, np.zeros((8, 8, 3), np.float32)], DataError),
            ([good, np.full((8, 8), np.nan, np.float32)], DataError),
            (interrupted(), KeyboardInterrupt),
        ]
        for frames, error in cases:
            with pytest.raises(error):
                write_video(tmp_path / name, frames, 25)
            assert not any(tmp_path.iterdir())

    def test_existing_and_unsupported_outputs(self, tmp_path):
        stack = np.zeros((2, 8, 8), np.float32)
        with pytest.raises(ConfigurationError, match=r"\.mkv"):
            write_video(tmp_path / "a.wmv", stack, 25)
        with pytest.raises(ConfigurationError, match="bit_depth"):
            write_video(tmp_path / "a.mkv", stack, 25, bit_depth=20)
        write_video(tmp_path / "a.mkv", stack, 25)
        with pytest.raises(OutputError):
            write_video(tmp_path / "a.mkv", stack, 25)
        write_video(tmp_path / "a.mkv", stack, 25, overwrite=True)
