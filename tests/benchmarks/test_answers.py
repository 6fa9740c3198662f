"""Readers of clips with answers: each reads what is drawn, says when it cannot, and a user's list is checked."""

import hashlib
import json
import re

import answers
import cv2
import numpy as np
import pytest
from blur_scenes import MARGIN

from turbrestore.core.errors import DataError, InputNotFoundError
from turbrestore.io.images.image_files import write_image

SIDE = answers.SIDE
INNER = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]


def drawn(kind, seed=0):
    scene, answer = answers.DRAWN[kind][1](SIDE + 2 * MARGIN, np.random.default_rng(seed))
    return scene[INNER], answer


def stars(*places, width=1.5):
    y, x = np.mgrid[:64, :64].astype(np.float32)
    light = sum(much * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * width**2)) for u, v, much in places)
    return np.float32(0.05 + light)


@pytest.mark.parametrize("kind", ["QR code", "EAN-13 bar code"])
def test_a_code_is_read_when_it_is_sharp_and_not_when_it_is_another_or_blurred(kind):
    for seed in range(5):
        scene, text = drawn(kind, seed)
        assert answers.code_read(scene, text) == 1
    assert answers.code_read(scene, text + "0") == 0
    assert answers.code_read(cv2.GaussianBlur(scene, (0, 0), 4), text) == 0


def test_a_bar_code_that_begins_with_0_is_read():
    codes = (drawn("EAN-13 bar code", seed) for seed in range(60))
    scene, text = next((scene, text) for scene, text in codes if text.startswith("0"))
    assert answers.code_read(scene, text) == 1


def test_the_distance_of_stars_counts_to_half_a_pixel():
    image, separation = stars((24.3, 30.0, 0.8), (33.1, 33.4, 0.4)), np.hypot(8.8, 3.4)
    for error, read in ((0, 1), (0.4, 1), (-0.4, 1), (0.6, 0), (-0.6, 0)):
        assert answers.two_apart(image, separation + error) == read


def test_one_star_and_two_without_a_dip_between_them_are_not_two():
    assert answers.two_apart(stars((24, 30, 0.8)), 2.0) == 0
    merged, shallow = (stars((24, 30, 0.8), (24 + apart, 30, 0.8), width=3.0) for apart in (2.0, 7.2))
    for image in (merged, shallow):
        assert not any(answers.two_apart(image, separation) for separation in np.arange(1, 10, 0.5))


def test_a_hot_pixel_beside_two_stars_is_no_star():
    image, separation = stars((24.3, 30.0, 0.8), (33.1, 33.4, 0.4)), np.hypot(8.8, 3.4)
    image[50, 50] += 0.9
    assert answers.two_apart(image, separation) == 1


@pytest.mark.parametrize("blur", [0.5, 2.0, 4.0])
def test_edges_bend_by_what_they_were_moved(blur):
    scene, lines = drawn("courses of a wall")
    assert answers.bending(cv2.GaussianBlur(scene, (0, 0), blur), lines) < 0.05
    x = np.arange(SIDE, dtype=np.float32)
    wave = 1.5 * np.sin(2 * np.pi * x / 70)
    columns, rows = np.meshgrid(x, x)
    blurred = cv2.GaussianBlur(scene, (0, 0), sigmaX=0.1, sigmaY=blur)
    moved = cv2.remap(blurred, columns, rows + wave[None], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    assert answers.bending(moved, lines) == pytest.approx(1.5 / 2**0.5, rel=0.15)


def test_edges_that_cannot_be_seen_are_not_straight():
    assert np.isnan(answers.bending(np.full((SIDE, SIDE), np.float32(0.5)), [[10, 50, 150, 50]]))


def test_a_reference_may_differ_by_shift_gain_and_offset():
    scene, _ = drawn("granules of the Sun")
    moved = np.roll(0.1 + 0.5 * scene, (2, -3), (0, 1))
    assert answers.likeness(moved, scene) > 45
    assert answers.likeness(cv2.GaussianBlur(scene, (0, 0), 3), scene) < 30


def test_a_simulated_clip_is_the_same_every_time_and_differs_by_seed():
    first, again, other = (answers.simulated("QR code", "kernels", seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.frames(), again.frames())
    assert first.answer == again.answer != other.answer
    assert answers.code_read(first.truth, first.answer) == 1


@pytest.fixture
def folder(tmp_path):
    """Two clips of still scenes: a code, and granules with their reference."""
    entries = []
    for kind, name in (("QR code", "label"), ("granules of the Sun", "sun")):
        scene, answer = drawn(kind)
        (tmp_path / name).mkdir()
        for number in range(6):
            write_image(tmp_path / name / f"{number}.png", scene, 8)
        files = [path.read_bytes() for path in sorted((tmp_path / name).iterdir())]
        digest, size = hashlib.sha256(b"".join(files)).hexdigest(), sum(map(len, files))
        entries.append({"clip": name, "bytes": size, "sha256": digest, "licence": "own", "answer": answer})
        entries[-1]["kind"] = answers.DRAWN[kind][0]
    write_image(tmp_path / "reference.png", scene, 8)
    entries[1]["answer"] = "reference.png"
    return tmp_path, entries


def listing(folder, entries):
    (folder / answers.LISTING).write_text(json.dumps(entries))


def test_a_folder_of_a_user_gives_a_table_that_holds_no_answer(folder, capsys):
    path, entries = folder
    listing(path, entries)
    assert answers.main([str(path)]) == 0
    printed = capsys.readouterr()
    assert "| label | own | share read | 1.00 | 1.00 | 1.00 | – |" in printed.out
    assert re.search(r"\| sun \| own \| PSNR, dB \| \S+ \| [\d.]+ \| [\d.]+ \| – \|", printed.out)
    assert entries[0]["answer"] not in printed.out + printed.err


def test_a_folder_without_a_list_is_refused(tmp_path):
    with pytest.raises(InputNotFoundError, match=r"answers\.json: expected the list of the clips"):
        answers.listed(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sha256": "0"}, "bytes, sha256 0, found"),
        ({"bytes": 7}, "expected 7 bytes"),
        ({"kind": "sound"}, "expected a kind of words, code, stars, lines, image, found sound"),
        ({"licence": ""}, "found no licence"),
        ({"answer": None}, "found no answer"),
        ({"answer": 12}, "expected a text as the answer of label"),
        ({"kind": "words", "answer": "AB12"}, "expected a list of words"),
        ({"kind": "stars", "answer": "5"}, "expected a number"),
        ({"kind": "lines", "answer": [1, 2, 3, 4]}, "expected a list of lines of four numbers"),
        ({"kind": "lines", "answer": [[1, 2, 1, 2]]}, "expected a list of lines of four numbers"),
        ({"kind": "image", "answer": 5}, "expected the path of an image"),
    ],
)
def test_what_is_not_as_listed_is_refused(folder, change, words):
    path, entries = folder
    listing(path, [entries[0] | change])
    with pytest.raises(DataError, match=words):
        answers.listed(path)


def test_words_are_compared_as_they_are_read(folder):
    path, entries = folder
    listing(path, [entries[0] | {"kind": "words", "answer": ["AB12", "Cde"]}])
    assert answers.listed(path)[0].answer == ["ab12", "cde"]


def test_a_stroke_in_a_name_is_part_of_the_path_and_no_cell(folder, capsys):
    path, entries = folder
    (path / "label").rename(path / "a|b")
    listing(path, [entries[0] | {"clip": "a|b", "licence": "CC|BY"}])
    assert answers.main([str(path)]) == 0
    assert r"| a\|b | CC\|BY |" in capsys.readouterr().out


def test_a_listed_clip_that_is_not_there_is_refused(folder, capsys):
    path, entries = folder
    listing(path, [entries[0] | {"clip": "lost.mp4"}])
    assert answers.main([str(path)]) == InputNotFoundError.exit_code
    assert "lost.mp4: expected the clip that answers.json lists, found none" in capsys.readouterr().err


def test_a_list_that_is_none_is_refused(tmp_path):
    for text in ("{", "[1]"):
        (tmp_path / answers.LISTING).write_text(text)
        with pytest.raises(DataError, match="expected a list of clips"):
            answers.listed(tmp_path)
