"""What the colours of a video mean: matrices, tags, HDR, and names of curves for grading."""

import av
import numpy as np
import pytest
from usual_files import HLG, PQ, hdr

from turbrestore.core.errors import ConfigurationError
from turbrestore.io.containers.encoding import Encoding
from turbrestore.io.containers.transfer_curves import remark_on_curve, sdr_of
from turbrestore.io.video import open_frames, write_video
from turbrestore_cli.__main__ import main

BARS = 0.2 + 0.6 * np.array([[r, g, b] for r in (0, 1) for g in (0, 1) for b in (0, 1)], np.float32)
PLACES = 16 * np.arange(8) + 8


def bars(height):
    return np.tile(np.repeat(BARS, 16, axis=0), (height, 1, 1))


def tags_of(path):
    with av.open(str(path)) as container:
        codec = container.streams.video[0].codec_context
        return tuple(int(tag) for tag in (codec.color_primaries, codec.color_trc, codec.colorspace, codec.color_range))


@pytest.mark.parametrize(
    ("name", "encoding", "tags"),
    [
        ("a.mp4", Encoding(), (1, 1, 1, 1)),
        ("a.mp4", Encoding("hevc"), (1, 1, 1, 1)),
        ("a.mkv", Encoding("h264"), (1, 1, 1, 1)),
        ("a.mkv", Encoding(), (1, 1, 0, 2)),
    ],
)
def test_written_colours_are_tagged_and_come_back(tmp_path, name, encoding, tags):
    write_video(tmp_path / name, [bars(96)] * 2, 25, 8, encoding=encoding)
    assert tags_of(tmp_path / name) == tags
    found = open_frames(tmp_path / name).read()[0, 48, PLACES]
    assert 255 * np.abs(found - BARS).max() < 2


def untagged(path, image):
    """H.264 that does not say its matrix: BT.709 from 720 rows on, else BT.601."""
    picture = av.VideoFrame.from_ndarray(np.rint(255 * image).astype(np.uint8), format="rgb24")
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=25, options={"crf": "4"})
        stream.height, stream.width, stream.pix_fmt = *image.shape[:2], "yuv444p"
        for number in range(2):
            frame = picture.reformat(format="yuv444p", dst_colorspace=1 if len(image) >= 720 else 5)
            frame.colorspace, frame.pts = 2, number
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))


@pytest.mark.parametrize("height", [96, 720])
def test_untagged_video_is_read_as_players_show_it(tmp_path, height):
    untagged(tmp_path / "a.mp4", bars(height))
    assert tags_of(tmp_path / "a.mp4")[2] == 2
    found = open_frames(tmp_path / "a.mp4").read()[0, height // 2, PLACES]
    assert 255 * np.abs(found - BARS).max() < 2


class TestHdr:
    @pytest.mark.parametrize(("transfer", "name"), [(HLG, "HLG"), (PQ, "PQ")])
    def test_light_up_to_the_knee_is_the_sdr_picture(self, tmp_path, transfer, name):
        frames = np.stack([0.85 * bars(96)] * 3)
        path = hdr(tmp_path, frames, transfer)
        source = open_frames(path)
        assert source.bit_depth == 10 and name in source.warnings[0] and "--hdr keep" in source.warnings[0]
        assert 255 * np.abs(source.read()[0, 48, PLACES] - frames[0, 48, PLACES]).max() < 5

    def test_codes_are_monotone_and_neutral(self):
        grey = np.repeat(np.append(np.arange(0, 65536, 64), 65535).astype(np.uint16)[None, :, None], 3, axis=2)
        for transfer in (HLG, PQ):
            shown = sdr_of(transfer)(grey).astype(int)
            assert np.diff(shown[0, :, 1]).min() >= 0 and np.ptp(shown, axis=2).max() <= 20
            assert shown.min() == 0 and shown.max() == 65535

    def test_kept_codes_stay_and_are_written_with_their_tags(self, tmp_path, capsys):
        frames = np.random.default_rng(0).uniform(0.3, 0.7, (1, 6, 8, 3)).repeat(8, axis=1).repeat(8, axis=2)
        path = hdr(tmp_path, np.repeat(frames, 4, axis=0) + 0.02 * np.arange(4)[:, None, None, None], HLG)
        assert "kept" in open_frames(path, hdr="keep").warnings[0]
        assert main(["steady", str(path), str(tmp_path / "b.mp4"), "--hdr", "keep", "--sigma", "0"]) == 0
        assert tags_of(tmp_path / "b.mp4") == (9, HLG, 9, 1)
        assert open_frames(tmp_path / "b.mp4", hdr="keep").format == "hevc/yuv420p10le"
        assert main(["steady", str(path), str(tmp_path / "c.mp4"), "--sigma", "0"]) == 0
        assert tags_of(tmp_path / "c.mp4") == (1, 1, 1, 1)
        capsys.readouterr()

    def test_another_choice_is_refused(self, tmp_path):
        with pytest.raises(ConfigurationError, match="hdr: expected sdr or keep"):
            open_frames(tmp_path, hdr="linear")


@pytest.mark.parametrize(("text", "name"), [("S-Log3", "S-Log3"), ("Apple Log", "Apple Log"), ("V-Log", "V-Log")])
def test_curves_for_grading_are_named(text, name):
    assert remark_on_curve(2, {"gamma": text}, False)[0].startswith(f"values are {name}, which")
    assert remark_on_curve(1, {"title": "catalog of dialogs", "encoder": "Lavc62"}, False) == ()
