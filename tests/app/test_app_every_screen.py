"""The app on phones, tablets and laptops, in both schemes: what axe-core finds, drawing by touch, and a sweep."""

import itertools
import signal
import subprocess
import sys

import pytest

from conftest import make_sequence
from turbrestore.io.video import write_video

from .conftest import LONG, press, tabs

SIZES = ((390, 844), (768, 1024), (1280, 860), (1440, 900))
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("start")
    write_video(folder / "clip.mkv", make_sequence(seed=4, count=8, size=64).frames, 25)
    words = [sys.executable, "-m", "turbrestore_cli", "app", "clip.mkv", "--no-browser"]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        yield process.stdout.readline().strip()
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=20)[1] == "turbrestore: interrupted\n"


@pytest.fixture
def open_tab(browser, address):
    with tabs(browser, address) as open_one:
        yield open_one


def serious(page):
    """Rules and elements of what axe-core finds serious or worse."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    found = axe.run(page, options={"resultTypes": ["violations"]}).response["violations"]
    return [
        (each["id"], node["target"])
        for each in found
        if each["impact"] in ("serious", "critical")
        for node in each["nodes"]
    ]


def sideways(page):
    return page.evaluate("document.documentElement.scrollWidth - innerWidth")


def test_axe_finds_nothing_serious_in_any_window(open_tab):
    page = open_tab(SIZES[-1])
    page.add_style_tag(content="* { transition: none !important; animation: none !important; }")
    press(page, "Run")
    page.get_by_text("64×64 pixels from 8 frames").wait_for(timeout=LONG)
    press(page, "Compare widths")
    page.get_by_text("4 of 4 widths").wait_for(timeout=LONG)
    page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
    views = itertools.cycle(("Clip", "Compare", "Widths"))
    for size, scheme in itertools.product(SIZES, ("light", "dark")):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        page.emulate_media(color_scheme=scheme)
        for _ in range(2):
            press(page, view := next(views))
            assert (size, view, sideways(page)) == (size, view, 0)
        assert (size, scheme, view, serious(page)) == (size, scheme, view, [])
    # A fault is found.
    page.evaluate("document.querySelector('.side').append(document.createElement('button'))")
    assert [rule for rule, _ in serious(page)] == ["button-name"]


def test_a_finger_draws_a_region(open_tab):
    page = open_tab(SIZES[0], has_touch=True, is_mobile=True)
    box = page.locator("#frame").bounding_box()
    touch = page.context.new_cdp_session(page)
    for kind, share in (("touchStart", 0.25), ("touchMove", 0.4), ("touchMove", 0.75), ("touchEnd", None)):
        at = [] if share is None else [{"x": box["x"] + share * box["width"], "y": box["y"] + share * box["height"]}]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})
    page.wait_for_function("document.querySelector('[aria-label=x]').value !== ''")
    sides = [int(page.get_by_label(name, exact=True).input_value()) for name in ("x", "y", "width", "height")]
    assert sides == pytest.approx([16, 16, 32, 32], abs=1)
    # The page stayed where it was, and a tap removes the region.
    assert page.evaluate("scrollY") == 0
    page.touchscreen.tap(box["x"] + 20, box["y"] + 20)
    page.wait_for_function("document.querySelector('[aria-label=x]').value === ''")


def test_widths_are_compared_and_one_is_chosen(open_tab):
    page = open_tab(SIZES[2])
    press(page, "Run")
    page.get_by_text("64×64 pixels from 8 frames").wait_for(timeout=LONG)
    widths = page.get_by_label("Widths to compare, pixels")
    for words, message in (("1, wide", "expected widths such as 1,1.4,2"), ("50", "expected 0 to 8 pixels")):
        widths.fill(words)
        press(page, "Compare widths")
        page.get_by_role("alert").get_by_text(f"Widths to compare: {message}").wait_for()
    widths.fill("0.5, 2.5")
    widths.press("Enter")
    page.get_by_text("2 of 2 widths").wait_for(timeout=LONG)
    titles = page.locator(".sheet .words").all_inner_texts()
    assert titles[0] == "not deblurred" and titles[1] == "0.5 px" and titles[2].startswith("2.5 px")
    sources = page.locator(".sheet img").evaluate_all("(images) => images.map((image) => image.src)")
    assert len(set(sources)) == 3
    page.locator(".sheet button").nth(1).click()
    page.get_by_text("press Apply for the whole image").wait_for(timeout=LONG)
    assert page.locator(".value").get_by_text(" px").inner_text() == "0.50 px"
    assert page.locator("#stage").is_visible()
