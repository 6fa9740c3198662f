"""Videos as cameras record them: turned, in any container, with pixels that are not square, begun in the middle."""

from pathlib import Path

import av
import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.io.video import open_frames, write_video
from videos import encode, refused, scene

FRAMES = scene()

ONE = 65536
# Display matrix (a, b, c, d) by what a player does to a frame: a pixel x, y is shown at a x + c y, b x + d y.
SHOWN = {
    "a quarter turn clockwise": ((0, ONE, -ONE, 0), lambda frame: np.rot90(frame, -1)),
    "half a turn": ((-ONE, 0, 0, -ONE), lambda frame: np.rot90(frame, 2)),
    "a quarter turn to the left": ((0, -ONE, ONE, 0), np.rot90),
    "mirrored": ((-ONE, 0, 0, ONE), lambda frame: frame[:, ::-1]),
    "transposed": ((0, ONE, ONE, 0), lambda frame: np.swapaxes(frame, 0, 1)),
}


def with_display_matrix(path, values):
    """Change the matrix in the track header of an MP4 file."""
    data, (a, b, c, d) = bytearray(path.read_bytes()), values
    start = data.find(b"tkhd") + 44
    data[start : start + 36] = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], ">i4").tobytes()
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("how", SHOWN)
def test_phone_videos_are_turned_upright(tmp_path, how):
    matrix, shown = SHOWN[how]
    path = encode(tmp_path / "a.mp4", scene(), "libx264", "yuv420p", "rgb24", crf="10")
    flat = open_frames(path).read()
    turned = open_frames(with_display_matrix(path, matrix))
    np.testing.assert_array_equal(turned.read(), [shown(frame) for frame in flat])
    assert turned.shape[1:] == shown(flat[0]).shape and turned.warnings == ("turned upright as players show it",)


def test_odd_rotations_are_remarked_on(tmp_path):
    path = encode(tmp_path / "a.mp4", scene(), "libx264", "yuv420p", "rgb24")
    (remark,) = open_frames(with_display_matrix(path, (46341, 46341, -46341, 46341))).warnings
    assert remark.startswith("rotation of ") and remark.endswith(" ignored")


def test_pixels_that_are_not_square_are_remarked_on(tmp_path):
    path = encode(tmp_path / "a.mp4", scene(), "libx264", "yuv420p", "rgb24", x264_params="sar=16/11")
    (remark,) = open_frames(path).warnings
    assert "16:11" in remark


@pytest.mark.parametrize("name", ["video", "video.tod"])
def test_content_counts_where_the_suffix_is_unknown(tmp_path, name):
    path = encode(tmp_path / "a.ts", scene(), "libx264", "yuv420p", "rgb24")
    assert len(open_frames(path.rename(tmp_path / name))) == 12


@pytest.mark.parametrize("suffix", [".wmv", ".ts", ".y4m", ".xyz"])
def test_playlists_are_not_opened(tmp_path, suffix):
    encode(tmp_path / "other.mkv", scene(), "libx264", "yuv420p", "rgb24")
    for text in ("ffconcat version 1.0\nfile other.mkv\n", "#EXTM3U\n#EXTINF:1,\nother.mkv\n"):
        (tmp_path / f"a{suffix}").write_text(text)
        refused(tmp_path / f"a{suffix}", DataError, f"a{suffix}")


@pytest.mark.parametrize("suffix", [".ts", ".mpg"])
def test_recordings_that_begin_in_the_middle(tmp_path, suffix):
    path = encode(tmp_path / f"a{suffix}", scene(40), "mpeg2video", "yuv420p", "rgb24", g="12", bf="2")
    data = path.read_bytes()
    Path(path).write_bytes(data[188 * (len(data) // 3 // 188) :])
    source = open_frames(path)
    with av.open(str(path)) as container:
        count = sum(1 for _ in container.decode(video=0))
    assert len(list(source)) == len(source) == count > 8
    assert "cannot be decoded" in source.warnings[0]


@pytest.mark.parametrize(("suffix", "codec"), [(".h264", "libx264"), (".265", "libx265")])
def test_elementary_streams_have_all_their_frames(tmp_path, suffix, codec):
    kind = "h264" if codec == "libx264" else "hevc"
    encode(tmp_path / f"a{suffix}", FRAMES, codec, "yuv420p", "rgb24", muxer=kind, crf="16")
    # Network recorders call anything a transport stream.
    (tmp_path / "b.ts").write_bytes((tmp_path / f"a{suffix}").read_bytes())
    for name in (f"a{suffix}", "b.ts"):
        found = open_frames(tmp_path / name).read()
        assert found.shape == (12, 48, 64, 3)
        assert [np.argmin(np.abs(np.float32(FRAMES) / 255 - one).mean(axis=(1, 2, 3))) for one in found] == [*range(12)]


@pytest.mark.parametrize(
    ("true", "named"), [(".ser", "a.avi"), (".npy", "a.mp4"), (".tif", "a.png"), (".mkv", "a.tif")]
)
def test_the_content_counts_where_the_suffix_lies(tmp_path, true, named):
    frames = np.float32(FRAMES)[..., 0] / 255
    write_video(tmp_path / f"a{true}", frames, 25)
    (tmp_path / f"a{true}").replace(tmp_path / named)
    np.testing.assert_array_equal(open_frames(tmp_path / named).read(), frames)
