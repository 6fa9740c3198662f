"""A sample of what benchmarks/hostile_input.py feeds the command line in full, and rules that hold everywhere."""

import ast
import os
import zipfile
from pathlib import Path

import cv2
import hostile_content as odd
import hostile_files as hostile
import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, DataError, InputNotFoundError
from turbrestore.io.limits import Limits
from turbrestore.io.npy import map_npy, read_npz
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video
from turbrestore_cli.__main__ import main
from videos import memory_below, packets

ROOT = Path(__file__).parents[2]


@pytest.fixture
def run(capfd):
    def call(*words):
        code = main([str(word) for word in words])
        out, err = capfd.readouterr()
        return code, out, err

    return call


def refused(result, folder, code=65):
    """One line on standard error, nothing on standard output, no file left."""
    found, out, err = result
    assert found == code, err
    assert out == "" and err.count("\n") == 1 and err.startswith("turbrestore: "), err
    assert not list(folder.glob("*.result.*"))


@pytest.mark.parametrize(("kind", "suffix"), hostile.FLIPPED.items())
def test_a_flipped_byte_ends_in_one_line_or_in_frames(run, tmp_path, kind, suffix):
    hostile.write_clip(tmp_path / f"whole{suffix}", kind)
    for data in hostile.flipped(tmp_path / f"whole{suffix}", kind, 4):
        (tmp_path / f"a{suffix}").write_bytes(data)
        result = run("info", tmp_path / f"a{suffix}", "--json")
        if kind.startswith("FFV1") or result[0]:
            refused(result, tmp_path)


# Those that take long to make are left to the benchmark, archives to TestArrayFiles.
BOMBS = [name for name in hostile.BOMBS if not name.startswith(("inflating", "comment")) and not name.endswith(".npz")]


@pytest.mark.parametrize("name", BOMBS)
def test_lying_headers_cost_no_memory(run, tmp_path, name):
    bomb = hostile.BOMBS[name]
    bomb.write(tmp_path / name)
    cv2.imwrite(str(tmp_path / "truth.png"), np.zeros((32, 32), np.uint8))
    places = {"input": tmp_path / name, "truth": tmp_path / "truth.png", "output": tmp_path / "a.result.png"}
    refused(run(*[word.format(**places) for word in bomb.command]), tmp_path)


def test_pipes_and_devices_are_no_input(run, tmp_path):
    """Whatever reads them would wait for a writer, or fill the memory."""
    cv2.imwrite(str(tmp_path / "truth.png"), np.zeros((32, 32), np.uint8))
    for suffix in (".mkv", ".npy", ".ser", ".tif"):
        os.mkfifo(tmp_path / f"a{suffix}")
        refused(run("info", tmp_path / f"a{suffix}"), tmp_path)
    for suffix in (".png", ".npz"):
        os.mkfifo(tmp_path / f"a{suffix}")
        refused(run("deconvolve", tmp_path / f"a{suffix}", tmp_path / "a.result.png"), tmp_path)
    for name, truth in (("z.png", "truth.png"), ("z.flo", "z.flo"), ("z.mkv", "truth.png")):
        (tmp_path / name).symlink_to("/dev/zero")
        result = run("evaluate", tmp_path / name, tmp_path / truth)
        refused(result, tmp_path)
        assert "a device" in result[2] or name == "z.mkv"
    for read in (read_npz, map_npy):
        with pytest.raises(DataError, match="a named pipe"):
            read(tmp_path / "a.npy")


CONTENT = {
    f"{content.name} {' '.join(content.options)}": content
    for content in odd.CONTENT
    if (content.refused or content.name in ("nan.npy", "two_scenes.mkv", "hot.mkv", "duplicated.mkv"))
    and not content.word.endswith("frames in")
}


@pytest.mark.parametrize("name", CONTENT)
def test_odd_content_is_told(run, tmp_path, name):
    content = CONTENT[name]
    path = tmp_path / content.name
    content.write(path)
    words = ["centroid", path, tmp_path / "a.result.npz", *content.options]
    result = run(*words)
    if content.refused:
        refused(result, tmp_path)
        assert content.word in result[2]
    else:
        assert result[0] == 0 and content.word in result[2]


class TestArrayFiles:
    def test_what_numpy_saves_is_read(self, tmp_path):
        arrays = {
            "f": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
            "text": np.array("a word"),
            "big": np.arange(4, dtype=">u2"),
            "none": np.empty((0, 3)),
        }
        np.savez(tmp_path / "a.npz", **arrays)
        found = read_npz(tmp_path / "a.npz")
        assert list(found) == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)
        np.save(tmp_path / "a.npy", arrays["f"])
        np.testing.assert_array_equal(map_npy(tmp_path / "a.npy"), arrays["f"])

    def test_missing_compressed_doubled_and_large_members_are_refused(self, tmp_path):
        for read in (read_npz, map_npy):
            with pytest.raises(InputNotFoundError):
                read(tmp_path / "none")
        np.savez_compressed(tmp_path / "a.npz", a=np.zeros(1000))
        with pytest.raises(DataError, match="compressed"):
            read_npz(tmp_path / "a.npz")
        np.savez(tmp_path / "a.npz", a=np.zeros(1000))
        with pytest.raises(DataError, match="up to 4000 bytes"):
            read_npz(tmp_path / "a.npz", Limits(max_bytes=4000))
        with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
            archive.writestr("a.npy", b"")
            archive.writestr("a.npy", b"")
        with pytest.raises(DataError, match="same name"):
            read_npz(tmp_path / "b.npz")

    @pytest.mark.parametrize(
        ("header", "body", "words"),
        [
            *[((shape,), bytes(32), "not a whole") for shape in ((2**62, 4), (10**9,), (-1, -8), (2**70,))],
            (((2,), "|O"), b"cbuiltins\nexec\n(S'raise SystemExit(99)'\ntR.", "Python objects"),
        ],
    )
    def test_lying_shapes_are_refused_and_objects_not_unpickled(self, tmp_path, header, body, words):
        data = hostile._npy_header(*header) + body
        (tmp_path / "a.npy").write_bytes(data)
        hostile._npz(tmp_path / "a.npz", {"a": data})
        for read, name in ((map_npy, "a.npy"), (read_npz, "a.npz")):
            with pytest.raises(DataError, match=words):
                read(tmp_path / name)

    def test_members_within_each_other_cost_no_memory(self, tmp_path):
        hostile._nested_npz(tmp_path / "a.npz")
        with memory_below(1e6), pytest.raises(DataError, match="members hold more than"):
            read_npz(tmp_path / "a.npz")


class TestSkippingDamage:
    def test_frames_whose_checksum_fails(self, tmp_path):
        path = tmp_path / "a.mkv"
        write_video(path, hostile.clip(), 25)
        whole = open_frames(path).read()
        data = bytearray(path.read_bytes())
        for number in (3, 8):
            data[data.index(packets(path)[number][1]) + 40] ^= 1
        path.write_bytes(data)
        with pytest.raises(DataError, match="frame 3 and 1 more"):
            open_frames(path)
        source = open_frames(path, skip_damaged=True)
        assert source.warnings == ("damaged: frames 3, 8 left out",)
        np.testing.assert_array_equal(source.read(), np.delete(whole, [3, 8], 0))
        part = open_frames(path, frames=(2, 8), skip_damaged=True)
        np.testing.assert_array_equal(part.read(), whole[[2, 4, 5, 6, 7]])

    def test_nothing_whole_is_refused_all_the_same(self, tmp_path):
        hostile.write_clip(tmp_path / "a.ser")
        (tmp_path / "a.ser").write_bytes((tmp_path / "a.ser").read_bytes()[:300])
        with pytest.raises(DataError, match="before the end of the first frame"):
            open_frames(tmp_path / "a.ser", skip_damaged=True)

    def test_strict_and_skipping_contradict(self, run, tmp_path):
        hostile.write_clip(tmp_path / "a.ser")
        refused(run("info", tmp_path / "a.ser", "--strict", "--skip-damaged"), tmp_path, 2)


def test_max_pixels_is_an_option_of_what_reads(run, tmp_path):
    clip, image = tmp_path / "a.npy", tmp_path / "a.png"
    hostile.write_clip(clip)
    cv2.imwrite(str(image), np.zeros((40, 40), np.uint8))
    few = ("--max-pixels", "1000")
    for words in (
        ("info", clip),
        ("centroid", clip, tmp_path / "a.result.npz"),
        ("flow", image, clip, tmp_path / "a.result.npy"),
        ("deconvolve", image, tmp_path / "a.result.png"),
        ("evaluate", image, image),
        ("synthesize", image, tmp_path / "a.result.mkv"),
        ("synthesize", "--model", "dynamic-texture", "--like", clip, "centroid", tmp_path / "a.result.mkv"),
    ):
        result = run(*words, *few)
        refused(result, tmp_path)
        assert "1000 pixels" in result[2]
    refused(run("info", clip, "--max-pixels", "0"), tmp_path, 2)
    refused(run("synthesize", "chart", tmp_path / "a.result.mkv", "--size", "40x40", *few), tmp_path, 2)
    assert run("info", clip, "--max-pixels", "4000")[0] == 0


@pytest.mark.parametrize("value", [0, -5, 1.5, True, "9"])
def test_limits_are_whole_numbers(value):
    for name in ("max_pixels", "max_frames", "max_bytes"):
        with pytest.raises(ConfigurationError, match=name):
            Limits(**{name: value})


def test_gaps_in_the_times_of_a_ser_file_are_told(tmp_path):
    write_video(tmp_path / "a.ser", hostile.clip(), 25)
    assert open_frames(tmp_path / "a.ser").warnings == ()
    data = bytearray((tmp_path / "a.ser").read_bytes())
    ticks = np.frombuffer(data[-96:], "<i8").copy()
    ticks[6:] += 10_000_000
    (tmp_path / "a.ser").write_bytes(data[:-96] + ticks.tobytes())
    assert open_frames(tmp_path / "a.ser").warnings == ("variable frame rate",)


def test_frames_left_out_are_not_asked_of_the_reader():
    asked = []

    def pixels(chosen):
        for number in chosen:
            asked.append(number)
            yield np.full((4, 5), number, np.uint8)

    source = FrameSource("a", "test", (9, 4, 5), 255, 8, pixels).without({2, 3, 20}, "gone")
    assert [int(frame[0, 0]) for frame in source.native()] == asked == [0, 1, 4, 5, 6, 7, 8]
    with pytest.raises(DataError, match="at least one frame"):
        source.without(range(9), "all")


SOURCES = sorted(path for folder in ("turbrestore", "cli") for path in (ROOT / folder).rglob("*.py"))


UNPICKLERS = {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal"}
RUNNERS = {"eval", "exec", "torch.load", "torch.jit.load", "pd.read_pickle"}
ARRAY_FILES = {"np.load", "numpy.load", "np.save", "np.savez", "np.lib.format.read_array", "np.lib.format.write_array"}


def test_nothing_is_ever_unpickled_or_evaluated():
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & UNPICKLERS, path
            if not isinstance(node, ast.Call):
                continue
            name = ast.unparse(node.func)
            assert name not in RUNNERS, path
            given = {keyword.arg: keyword.value for keyword in node.keywords}
            allowed = given.get("allow_pickle", ast.Constant("missing" if name in ARRAY_FILES else False))
            assert ast.unparse(allowed) == "False", f"{name} in {path}"
