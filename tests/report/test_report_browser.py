"""The report in a browser: it shows what it should, reacts, keeps to itself."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.decision import Decision
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.io.source import FrameSource
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.report import write_report
from turbrestore.runs.run_record import describe_run

from .conftest import NARROW, WIDE

EVIL = "<script>document.title='taken'</script><img src=x onerror=document.title='taken'>.mkv"


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    # Wider than a column of the page without scripts, and than a phone.
    frames = make_sequence(seed=41, count=4, size=400, rms=0.8).frames[:, 150:230]
    deconvolution = DeconvolutionParams(sigma=1.0, iterations=10)
    params = RestoreParams(centroid=CentroidParams(iterations=1), deconvolution=deconvolution)
    source = FrameSource.from_array(frames, EVIL, fps=25.0)
    run = describe_run(source, params, ("turbrestore", "restore", f"{'long-folder/' * 12}{EVIL}", "o.png"))
    decision = Decision("a-subject-of-one-long-word", "removed 1 px", "figures that take up some room on the line " * 3)
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, dataclasses.replace(restore(frames, params), decisions=(decision,)), run)
    return path


def pixels(element):
    return cv2.imdecode(np.frombuffer(element.screenshot(), np.uint8), cv2.IMREAD_COLOR).astype(int)


def changed(before, after):
    """Columns in which two screenshots differ."""
    return np.flatnonzero((before != after).any(axis=(0, 2)))


def test_everything_loads_and_stays_inside(open_page):
    page = open_page()
    widths = page.evaluate("[...document.images].map((image) => image.naturalWidth)")
    assert widths == [400] * 5
    maps = page.evaluate("[...document.querySelectorAll('svg image')].map((image) => image.getBBox().width)")
    assert len(maps) >= 2
    assert min(maps) > 0
    # Labels that are wider than planned are not cut.
    assert page.locator(".maps svg").first.evaluate("(plot) => getComputedStyle(plot).overflow") == "visible"
    assert page.evaluate("getComputedStyle(document.querySelector('h1')).overflowWrap") == "anywhere"


def test_policy_holds_for_markup_that_got_in_all_the_same(browser, report):
    page = browser.new_page()
    complaints = []
    page.on("console", lambda message: complaints.append(message.text))
    page.goto(report.as_uri())
    markup = "<img src=x onerror=document.title='taken'><img src=http://localhost/y><p style='color: red'>"
    with page.expect_console_message(lambda _: len(complaints) >= 3):
        page.evaluate(f"document.body.insertAdjacentHTML('beforeend', `{markup}`)")
    page.wait_for_timeout(200)
    assert all("Content Security Policy" in text for text in complaints)
    assert page.title() == f"{EVIL} – turbrestore"
    page.close()


def test_slider_moves_the_border_between_the_images(open_page):
    page = open_page()
    stage, divider = page.locator("#stage"), page.locator("#divider")
    shots = {}
    for share in (0, 50, 100):
        divider.fill(str(share))
        shots[share] = pixels(stage)
    width = shots[0].shape[1]
    # Between 0 and 50 only the left half changes, but for the handle.
    assert changed(shots[0], shots[50]).max() < 0.53 * width
    assert changed(shots[50], shots[100]).min() > 0.47 * width
    assert changed(shots[0], shots[100]).size > 0.5 * width


def test_divider_runs_over_the_image_where_the_stage_is_wider(open_page):
    page = open_page({"width": 1000, "height": 120})
    stage, image, line = (page.locator(name) for name in ("#stage", ".left img", "#line"))
    assert image.bounding_box()["width"] < 0.8 * stage.bounding_box()["width"]
    for share in (0, 100):
        page.locator("#divider").fill(str(share))
        box, place = image.bounding_box(), line.bounding_box()
        assert place["x"] + place["width"] / 2 == pytest.approx(box["x"] + share / 100 * box["width"], abs=1)


def test_any_two_can_be_chosen(open_page):
    page = open_page()
    names = page.locator("#left option").all_inner_texts()
    assert (
        names
        == page.locator("#right option").all_inner_texts()
        == ["Frame 2", "Mean", "Centroid", "Filtered", "Result"]
    )
    stage = page.locator("#stage")
    before = pixels(stage)
    page.get_by_label("Left").select_option("Mean")
    after = pixels(stage)
    assert changed(before, after).max() < 0.53 * after.shape[1]
    assert "Mean on the left 50 %" in page.locator("#divider").get_attribute("aria-valuetext")
    page.get_by_label("Right").select_option("Mean")
    assert page.locator(".layer:visible").count() == 1


def test_keyboard_reaches_and_moves_everything(open_page):
    page = open_page()
    reached = []
    for _ in range(12):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.id || document.activeElement.tagName"))
    assert reached[1:9] == ["left", "divider", "right", "stage", "out", "in", "fit", "actual"]
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    page.locator("#divider").focus()
    before = pixels(page.locator("#stage"))
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    assert page.locator("#divider").input_value() == "55"
    assert changed(before, pixels(page.locator("#stage"))).size
    page.locator("#stage").focus()
    page.keyboard.press("ArrowLeft")
    assert page.locator("#divider").input_value() == "54"


def test_zoom_by_keys_is_pixelated_and_pans(open_page):
    page = open_page()
    stage, zoom = page.locator("#stage"), page.locator("#zoom")
    stage.focus()
    fitted = int(zoom.inner_text().split()[0])
    for _ in range(4):
        page.keyboard.press("+")
    assert int(zoom.inner_text().split()[0]) == pytest.approx(fitted * 1.25**4, rel=0.01)
    assert page.evaluate("getComputedStyle(document.querySelector('.left img')).imageRendering") == "pixelated"
    before = pixels(stage)
    page.keyboard.press("ArrowRight")
    assert changed(before, pixels(stage)).size
    page.keyboard.press("0")
    assert zoom.inner_text() == f"{fitted} %"
    page.get_by_role("button", name="1:1").click()
    assert zoom.inner_text() == "100 %"
    assert page.get_by_role("button", name="Zoom out").is_disabled()


def test_mouse_drags_the_border_and_the_image(open_page):
    page = open_page()
    page.locator("#stage").scroll_into_view_if_needed()
    box = page.locator("#stage").bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] / 2, middle)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 4, middle)
    page.mouse.up()
    assert page.locator("#divider").input_value() == "25"
    for _ in range(3):
        page.get_by_role("button", name="Zoom in").click()
    place = "getComputedStyle(document.querySelector('.left img')).transform"
    before = page.evaluate(place)
    # Reaching for the buttons has scrolled the page.
    box = page.locator("#stage").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 30, box["y"] + box["height"] / 2 + 10)
    page.mouse.up()
    assert page.locator("#divider").input_value() == "25"
    assert page.evaluate(place) != before


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [WIDE, NARROW], ids=["wide", "narrow"])
def test_fits_in_both_schemes(open_page, size, scheme):
    page = open_page(size, color_scheme=scheme)
    page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    ground, ink = (
        sum(int(part) for part in page.evaluate(f"getComputedStyle(document.body).{name}")[4:-1].split(","))
        for name in ("backgroundColor", "color")
    )
    assert (ground > ink) == (scheme == "light")
    stage, image = (page.locator(name).bounding_box() for name in ("#stage", ".left img"))
    assert image["width"] == pytest.approx(stage["width"], abs=1)
    assert image["height"] == pytest.approx(stage["height"], abs=1)
    # Plots follow the page: their text has the colour of its notes.
    colours = page.evaluate(
        "[getComputedStyle(document.querySelector('.plot text')).fill,"
        " getComputedStyle(document.querySelector('.plot figcaption')).color]"
    )
    assert colours[0] == colours[1]


def test_without_scripts_the_images_stand_side_by_side(open_page):
    page = open_page(java_script_enabled=False)
    assert page.locator(".layer img").count() == 5
    assert all(image.is_visible() for image in page.locator(".layer img").all())
    assert not page.locator("#divider").is_visible()
