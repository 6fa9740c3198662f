"""What the command line refuses: one line that says why, and nothing is left behind."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import QUICKEST, fails

from turbrestore.io.images.image_files import write_image
from turbrestore.io.video import write_video


def renamed_text(folder):
    (folder / "text.mp4").write_text("no video")
    return folder / "text.mp4"


def constant(folder):
    np.save(folder / "grey.npy", np.full((5, 64, 64), 0.5, np.float32))
    return folder / "grey.npy"


@pytest.mark.parametrize(
    ("make", "code", "part"),
    [
        (lambda folder: folder / "missing.mp4", 66, "missing.mp4"),
        (renamed_text, 65, "text.mp4"),
        (constant, 65, "contrast"),
    ],
    ids=["missing", "text", "constant"],
)
def test_bad_input_is_one_line_and_leaves_nothing(run, tmp_path, make, code, part):
    source = make(tmp_path)
    outputs = tmp_path / "outputs"
    outputs.mkdir()
    fails(run("restore", source, outputs / "o.png", "--keep", outputs / "keep"), code, part)
    assert list(outputs.iterdir()) == []


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("http://host//a.mkv", "http://host//a.mkv: no such file or folder; addresses are not opened"),
        ("-", "-: expected the name of a file; steady alone reads and writes standard streams"),
        ("night/*.ser", "night/*.ser: no such file or folder; batch takes patterns"),
        ("./frame%03d.png", "./frame%03d.png: no such file or folder; a series of images is read by the name of its"),
        ("-/-a.mkv", "-/-a.mkv: taken for an option; write ./-/-a.mkv, or --"),
        ("a//b.mkv", "a//b.mkv: no such file or folder\n"),
    ],
)
def test_a_word_is_shown_as_typed_with_what_it_may_mean(run, tmp_path, monkeypatch, word, told):
    monkeypatch.chdir(tmp_path)
    fails(run("info", word), 2 if word == "-/-a.mkv" else 66, told)
    # A file of that name is read.
    (tmp_path / "-a.mkv").write_bytes(b"")
    fails(run("info", "--", "-a.mkv"), 65, "-a.mkv: ")


def test_outputs_that_cannot_be(run, clip, tmp_path):
    copy = tmp_path / "copy.png"
    copy.write_bytes(clip.read_bytes())
    folder = tmp_path / "frames"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.zeros((32, 32), np.uint8))
    fails(run("restore", copy, copy, "--overwrite"), 73, "copy.png")
    fails(run("restore", folder, folder / "b.png"), 73, "frames")
    fails(run("restore", clip, ""), 2)
    fails(run("restore", clip, "/proc/o.png"), 73, "/proc")
    fails(run("restore", clip, tmp_path / "o.jpg"), 2, ".png")
    fails(run("restore", clip, tmp_path / "o.png", "--keep", copy), 73, "copy.png")
    fails(run("restore", clip, tmp_path / "o.png", "--keep", tmp_path / "o.png"), 73, "already")
    fails(run("restore", folder, tmp_path / "o.png", "--keep", folder, "--overwrite"), 73, "already")
    fails(run("restore", clip, tmp_path / "o.png", "--keep", folder), 73, "not empty")
    assert [path.name for path in folder.iterdir()] == ["a.png"]
    assert copy.read_bytes() == clip.read_bytes()


class TestFilesOfOneRun:
    """No output is another one, or anything that is read, under any name."""

    @pytest.fixture
    def here(self, clip, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        write_video(Path("dark.npy"), np.zeros((2, 80, 80), np.float32), 25, 32)
        write_image(Path("mask.png"), np.eye(80, dtype=np.float32), 8)
        return {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def refuses(self, run, here, words, *parts):
        fails(run(*words, "--overwrite"), 73, *parts)
        assert {path.name: path.read_bytes() for path in Path().iterdir()} == here

    @pytest.mark.parametrize("other", ["o.tif", "./o.tif", "none/../o.tif"])
    def test_outputs_of_restore_differ(self, run, clip, here, other):
        words = ["restore", clip, "o.tif", "--uncertainty", other, *QUICKEST]
        self.refuses(run, here, words, f"{Path(other)}: is named for two outputs")

    def test_a_link_is_no_other_output(self, run, clip, here, tmp_path):
        Path("link.mkv").symlink_to("o.mkv")
        fails(run("steady", clip, "o.mkv", "--mask", "link.mkv", "--overwrite"), 73, "is named for two outputs")

    @pytest.mark.parametrize("option", ["--dark", "--flat"])
    @pytest.mark.parametrize("words", [("steady", "c"), ("flow", "mask.png", "c")])
    def test_calibration_stays(self, run, clip, here, option, words):
        words = [clip if word == "c" else word for word in words]
        self.refuses(run, here, [*words, "dark.npy", option, "dark.npy"], "is the input")

    @pytest.mark.parametrize("output", [["mask.png"], ["o.png", "--keep", "."]])
    def test_the_mask_of_overlays_stays(self, run, clip, here, output):
        Path("frame.png").write_bytes(here["mask.png"])
        here["frame.png"] = here["mask.png"]
        name = output[0] if len(output) == 1 else "frame.png"
        self.refuses(run, here, ["restore", clip, *output, "--static-mask", name, *QUICKEST], name)


def test_errors_name_options_as_they_were_typed(run, clip, tmp_path):
    taken = tmp_path / "taken.png"
    taken.write_text("")
    new = tmp_path / "new.png"
    for words, expected in {
        ("restore", clip, new, "--train", "1"): "--train: expected 2 frames or more, found 1",
        ("restore", clip, new, "--frames=100:200"): "--frames: expected a range within 0:8, found 100:200",
        ("restore", clip, new, "--keep-best", "200%"): "--keep-best: expected a share",
        ("restore", clip, new, "--centroid.iterations", "0"): "--centroid.iterations: expected 1 to 1000, found 0",
        ("restore", clip, new, "--until", "filter", "--sigma", "1"): "--sigma: has no effect with until = filter",
        ("restore", clip, taken): "choose another name or add --overwrite",
        ("restore", clip): "OUTPUT: expected a value, found none; turbrestore restore --help",
        ("sharp", clip): "sharp: no such command; turbrestore --help",
        ("restor", clip): 'Did you mean "restore"?',
        ("steady", clip, "o.mkv", "--derotat", "jupiter"): "Did you mean --derotate?",
        ("steady", "-", "o.mkv", "--roi", "0,0,9,9"): "leave out the options that select or repair frames\n",
    }.items():
        fails(run(*words), 73 if words[2:] == (taken,) else 2, expected)
    assert not new.exists()


def test_a_hyphen_for_an_image_lists_no_suffixes(run, tmp_path):
    _, _, told = run("deconvolve", "-", tmp_path / "o.png")
    assert told == "turbrestore: -: expected the name of a file; steady alone reads and writes standard streams\n"


@pytest.mark.parametrize("option", ["--rotat", "--rotate", "--layers", "--port"])
def test_options_that_mean_something_else_are_not_suggested(run, clip, option):
    _, _, told = run("steady", clip, "o.mp4", option)
    assert told == f"turbrestore: Unknown option: {option}.\n"
