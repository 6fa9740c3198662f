"""The page of a steadied video, in text and in a browser."""

import html
from pathlib import Path

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import OutputError
from turbrestore.io.source import FrameSource
from turbrestore.report import SteadyFigures, steadied, write_steady_report
from turbrestore.runs.run_record import describe_run
from turbrestore_cli.__main__ import main

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
    figures = SteadyFigures([0.5] * COUNT, [0.25] * COUNT, 2, 1.25, 4.0)
    command = ("turbrestore", "steady", EVIL, "o.mkv")
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_steady_report(path, sources, masks, figures, describe_run(sources[0], {"camera": "lock"}, command))
    return path


def test_panels_show_input_output_difference_and_what_moves():
    seen, ours = np.full((4, 6), 0.4, np.float32), np.full((4, 6), 0.5, np.float32)
    mask = np.zeros((4, 6), bool)
    mask[:, 3:] = True
    (frame,) = steadied._panels([(seen, ours)], [mask])
    assert frame.shape == (8, 12, 3)
    for part, value in (
        (np.s_[:4, :6], 0.4),
        (np.s_[:4, 6:], 0.5),
        (np.s_[4:, :6], 0.5 + 0.1 * steadied._ENLARGED),
        (np.s_[4:, 6:9], 0.5 * steadied._DIMMED),
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
    assert "<script" not in page
    for text in ("0.50 px", "1.25 px", "25 %", "2 scenes", "2.0 a second", "lock"):
        assert text in page


def test_the_page_is_not_replaced_unasked(report, sources):
    before = report.read_bytes()
    with pytest.raises(OutputError):
        write_steady_report(report, sources, [], SteadyFigures(), describe_run(sources[0]))
    assert report.read_bytes() == before


def until(page, condition):
    """Wait; the page's policy forbids what wait_for_function does while it polls."""
    for _ in range(200):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(100)
    pytest.fail(f"never came true: {condition}")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_film_plays_in_a_browser(browser, report, scheme):
    context = browser.new_context(viewport={"width": 400, "height": 700}, color_scheme=scheme)
    page, complaints = context.new_page(), []
    page.on("console", lambda message: complaints.append(message.text))
    page.goto(report.as_uri())
    until(page, "film.readyState >= 2 || film.error !== null")
    assert page.evaluate("[film.videoWidth, film.videoHeight]") == [2 * WIDTH, 2 * HEIGHT]
    assert page.evaluate("film.duration") == pytest.approx(COUNT / 25)
    page.evaluate("film.controls = false; film.currentTime = 0.1")
    until(page, "!film.seeking")
    shot = cv2.imdecode(np.frombuffer(page.locator("#film").screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
    quarters = [part for half in np.array_split(shot, 2) for part in np.array_split(half, 2, 1)]
    # The output has half the contrast of the input, and its right half, which stands still, is dimmed.
    assert 1.5 < np.ptp(quarters[0].astype(int)) / np.ptp(quarters[1].astype(int)) < 2.7
    dimmed, bright = (half.mean() for half in (quarters[3][:, -8:], quarters[1][:, -8:]))
    assert dimmed < 0.5 * bright
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    assert complaints == []
    context.close()


def test_command_writes_the_page(tmp_path):
    sample = Path(__file__).parents[2] / "sample_data" / "chart.mkv"
    words = [sample, tmp_path / "o.mkv", "--frames", "0:4", "--roi", "40,40,64,48", "--sigma", "0", "--quiet"]
    assert main(["steady", *map(str, words), "--report", str(tmp_path / "o.html")]) == 0
    assert "data:video/mp4;base64," in (tmp_path / "o.html").read_text()
