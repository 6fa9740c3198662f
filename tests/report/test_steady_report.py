"""The page of a steadied video, in text and in a browser."""

import base64
import html
from pathlib import Path

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import OutputError
from turbrestore.io.source import FrameSource
from turbrestore.report import SteadyFigures, film, steadied, write_steady_report
from turbrestore.runs.run_record import describe_run
from turbrestore_cli.__main__ import main

from .conftest import WIDE

EVIL = "<script>document.title='taken'</script>.mkv"
COUNT, HEIGHT, WIDTH = 8, 33, 47


@pytest.fixture(scope="module")
def sources():
    """A grey input, and an output of half its contrast that stands still; odd sizes."""
    ramp = np.linspace(0, 1, WIDTH, dtype=np.float32)[None].repeat(HEIGHT, 0)
    frames = np.stack([np.roll(ramp, number, 1) for number in range(COUNT)])
    output = np.stack([0.25 + 0.5 * ramp] * COUNT)
    return FrameSource.from_array(frames, EVIL, fps=25.0), FrameSource.from_array(output, "o.mkv", fps=25.0)


@pytest.fixture(scope="module")
def report(sources, tmp_path_factory):
    masks = np.zeros((COUNT, HEIGHT, WIDTH), bool)
    masks[:, :, : WIDTH // 2] = True
    figures = SteadyFigures([0.5] * COUNT, [0.25] * COUNT, [0.0] * COUNT, 2, 1.25, 4.0)
    command = ("turbrestore", "steady", EVIL, "o.mkv")
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_steady_report(path, sources, masks, figures, describe_run(sources[0], {"camera": "lock"}, command))
    return path


def test_panels_show_input_output_difference_and_what_moves():
    seen, ours = np.full((4, 6), 0.4, np.float32), np.full((4, 6), 0.5, np.float32)
    mask = np.zeros((4, 6), bool)
    mask[:, 3:] = True
    frame = film._arranged(film._panel(seen), film._panel(ours), mask)
    assert frame.shape == (8, 12, 3)
    for part, value in (
        (np.s_[:4, :6], 0.4),
        (np.s_[:4, 6:], 0.5),
        (np.s_[4:, :6], 0.5 + 0.1 * film._ENLARGED),
        (np.s_[4:, 6:9], 0.5 * film._DIMMED),
        (np.s_[4:, 9:], 0.5),
    ):
        assert np.allclose(frame[part], value)


def test_output_is_compared_with_the_input_frame_by_frame(sources):
    sharp, change = [], []
    assert len(list(steadied._compared(sources, sharp, change))) == COUNT
    assert sharp[0] == pytest.approx(0.5)
    assert np.isnan(change[0])
    assert change[1:] == [0.0] * (COUNT - 1)


def test_page_says_what_was_done(report):
    page = report.read_text()
    assert EVIL in html.unescape(page)
    assert page.count("<script") == 1
    for text in ("0.50 px", "1.25 px", "25 %", "2 scenes", "2.0 frames a second", "lock"):
        assert text in page


def test_the_page_is_not_replaced_unasked(report, sources):
    before = report.read_bytes()
    with pytest.raises(OutputError):
        write_steady_report(report, sources, [], SteadyFigures(), describe_run(sources[0]))
    assert report.read_bytes() == before


def until(page, condition):
    """Wait; the page's policy forbids what wait_for_function does while it polls."""
    for _ in range(600):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(100)
    pytest.fail(f"never came true: {condition}")


@pytest.fixture
def open_film(open_page):
    def call(size=WIDE, **options):
        page = open_page(size, **options)
        until(page, "film.readyState >= 2 || film.error !== null")
        return page

    return call


def levels(page, key):
    """What is drawn of one panel, grey levels."""
    address = page.evaluate(f"document.querySelector('[data-key={key}] canvas').toDataURL()")
    data = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)[:HEIGHT, :WIDTH].astype(float)


def test_film_shows_two_panels_of_one_frame(open_film):
    page = open_film()
    assert page.evaluate("[film.videoWidth, film.videoHeight]") == [2 * (WIDTH + 1), 2 * (HEIGHT + 1)]
    assert page.evaluate("film.duration") == pytest.approx(COUNT / 25)
    shown = page.locator("#frame-shown")
    page.locator("#stage").focus()
    for _ in range(3):
        before = shown.inner_text()
        page.keyboard.press(".")
        until(page, f"document.getElementById('frame-shown').textContent !== '{before}'")
    assert shown.inner_text() == "3"
    # The input is a ramp that moves by a column a frame; the output has half its contrast.
    ramp = np.linspace(0, 255, WIDTH)
    assert abs(levels(page, "input") - np.roll(ramp, 3)).mean() < 12
    assert abs(levels(page, "output") - (64 + ramp / 2)).mean() < 12
    page.keyboard.press(",")
    until(page, "document.getElementById('frame-shown').textContent === '2'")
    assert abs(levels(page, "input") - np.roll(ramp, 2)).mean() < 12
    page.get_by_label("Right").select_option("What moves")
    # The page draws it before its next picture.
    page.evaluate("new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    moving = levels(page, "moving")
    # The right half of the picture stands still, and is dimmed.
    assert 0 < moving[:, -8:].mean() < 0.5 * levels(page, "output")[:, -8:].mean()


def test_film_plays_and_loops(open_film):
    page = open_film()
    page.locator("#stage").focus()
    page.evaluate("film.addEventListener('seeked', () => { window.looped = true; }); 0")
    page.keyboard.press(" ")
    until(page, "window.looped === true")
    assert page.get_by_role("button", name="Pause").is_visible()
    page.get_by_role("button", name="Pause").click()
    assert page.evaluate("film.paused")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 860)])
def test_figures_and_film_are_within_the_window(open_film, width, height, scheme):
    page = open_film({"width": width, "height": height}, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    boxes = [element.bounding_box() for element in page.locator(".headline > div").all()]
    # No figure stands alone in the last row.
    assert sum(box["y"] == boxes[-1]["y"] for box in boxes) in ((6,) if width > 900 else (2,))
    player = page.locator(".player").bounding_box()
    assert player["height"] < height


def test_without_scripts_the_film_has_its_own_controls(open_page):
    page = open_page(java_script_enabled=False)
    assert page.locator("#film").is_visible()
    assert not page.locator("#stage").is_visible()


def test_command_writes_the_page(tmp_path):
    sample = Path(__file__).parents[2] / "sample_data" / "chart.mkv"
    words = [sample, tmp_path / "o.mkv", "--frames", "0:4", "--roi", "40,40,64,48", "--sigma", "0", "--quiet"]
    assert main(["steady", *map(str, words), "--report", str(tmp_path / "o.html")]) == 0
    assert "data:video/mp4;base64," in (tmp_path / "o.html").read_text()
