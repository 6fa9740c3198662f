"""The app in a browser, from the opening of a clip to the saved image, as a person would use it."""

import re
import shlex
import shutil
import time
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.video import open_frames, write_video
from turbrestore_cli.__main__ import main

from .conftest import EVIL, LONG, PART, SAMPLE, draw, drop, open_another, press, push, wait_for_result

pytestmark = pytest.mark.long


def begin_run(page):
    """Press *Run*, and wait until it has begun; a short one may have ended by then."""
    press(page, "Run")
    begun = page.get_by_role("button", name="Stop", exact=True).or_(page.get_by_text(" frames in "))
    begun.first.wait_for(timeout=LONG)


def pixels(element):
    return cv2.imdecode(np.frombuffer(element.screenshot(), np.uint8), cv2.IMREAD_COLOR).astype(int)


def soon(look, there=bool):
    """Look again and again until there is something, at most for half a minute, and return what is seen then."""
    until = time.monotonic() + 30
    while not there(seen := look()) and time.monotonic() < until:
        time.sleep(0.05)
    return seen


def test_from_the_clip_to_the_saved_image(open_tab, app, monkeypatch):
    from playwright.sync_api import expect

    page = open_tab()
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    assert page.get_by_text("192×144 pixels, 8 bits, 48 frames, 1.9 s at 25 per second").is_visible()
    before = pixels(page.locator("#frame"))
    push(page, "Frame", "PageDown")
    assert soon(lambda: pixels(page.locator("#frame")) != before, np.any).any()

    draw(page, 0.25, 0.25, 0.5625, 0.6875)
    page.wait_for_function("document.querySelector('[aria-label=x]').value !== ''")
    sides = [int(page.get_by_label(name, exact=True).input_value()) for name in ("x", "y", "width", "height")]
    assert sides == pytest.approx([48, 36, 60, 63], abs=1)
    page.get_by_label("last", exact=True).fill("15")
    press(page, "Run")
    wait_for_result(page, f"{sides[2]}×{sides[3]} pixels from 16 frames")
    expect(page.locator("#right option")).to_have_text(["Frame", "Mean", "Centroid", "Filtered", "Result"])
    page.wait_for_function("[...document.querySelectorAll('#stage img')].every((image) => image.complete)")
    page.get_by_text("decisions").click()
    assert page.locator("dt").get_by_text("blur: ").is_visible()
    verdict = re.compile(r"Finished in .+ s\. Verdict: .+ 16 frames.+(looks right|check: .+)\.$")
    assert page.get_by_text(verdict).is_visible()

    stage, before = page.locator("#stage"), pixels(page.locator("#stage"))
    push(page, "Width of the blur, pixels", "PageUp")
    # On a quick machine the exact one is there before the page is looked at.
    page.get_by_text(re.compile("the exact one follows|press Apply for the whole")).first.wait_for()
    page.get_by_text("press Apply for the whole image").wait_for()
    middle = before.shape[1] // 2
    changed = soon(lambda: (pixels(stage) != before).any(axis=(0, 2)), np.any)
    assert changed[middle + 20 :].any()
    assert not changed[: middle - 20].any()

    page.get_by_label("Image, .png, .tif or .fits").fill("saved.png")
    page.get_by_role("button", name="Copy command").first.click()
    page.get_by_text("The command is copied").wait_for()
    command = shlex.split(soon(lambda: page.evaluate("navigator.clipboard.readText()")))
    press(page, "Save")
    page.get_by_text("Saved: saved.png, saved.png.toml").wait_for(timeout=LONG)
    assert command[:4] == ["turbrestore", "restore", "chart.mkv", "saved.png"]
    assert any(word.startswith("--sigma=") for word in command)
    monkeypatch.chdir(app.folder)
    assert main(["restore", "chart.mkv", "again.png", *command[4:], "--quiet"]) == 0
    assert Path("again.png").read_bytes() == Path("saved.png").read_bytes()
    assert Path("again.png.toml").read_bytes() == Path("saved.png.toml").read_bytes()

    page.get_by_label("Widths to compare, pixels").fill("1, wide")
    press(page, "Compare widths")
    page.get_by_role("alert").get_by_text("expected widths").wait_for()
    page.get_by_text("Saved: saved.png, saved.png.toml").wait_for(state="hidden")

    press(page, "Save")
    page.get_by_role("alert").get_by_text("saved.png").wait_for()


def test_frames_are_chosen_by_the_strip_and_the_line(open_tab):
    page = open_tab()
    page.locator(".strip button").nth(1).click()
    page.locator(".view .value").get_by_text("9", exact=True).wait_for()
    page.get_by_text("Stacking", exact=True).click()
    page.get_by_label("last", exact=True).fill("39")
    page.get_by_text("40 of 40 frames kept; drag the line").wait_for()
    graph = page.locator("svg.quality")
    graph.scroll_into_view_if_needed()
    box = graph.bounding_box()
    page.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 10)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 10, steps=4)
    page.mouse.up()
    page.get_by_text("12 of 40 frames kept").wait_for()
    # The sharpest stand first, and the line behind the last that is kept.
    heights = graph.locator("rect").evaluate_all("(bars) => bars.map((bar) => Number(bar.getAttribute('height')))")
    assert len(heights) == 40 and heights == sorted(heights, reverse=True)
    level = graph.locator(".level").bounding_box()
    assert level["x"] - box["x"] == pytest.approx(0.3 * box["width"], abs=2)
    # What a share costs and gains stands beside it, and a press keeps it.
    shares = page.get_by_label("Shares to keep")
    cells = shares.inner_text().split()
    assert cells[4:9] == ["Worth", "10", "%", "4", "3.16×"]
    shares.get_by_role("button", name="25 %", exact=True).click()
    page.get_by_text("10 of 40 frames kept").wait_for()
    # None is suggested where all frames are worth as much.
    assert shares.get_by_role("button", name=re.compile("suggested")).count() == 0
    page.get_by_text("No share is clearly worth more than all frames.").wait_for()


def test_a_clip_is_placed_on_another_result_and_made_finer(open_tab, app):
    page = open_tab()
    page.get_by_label("last", exact=True).fill("5")
    page.get_by_text("Stacking", exact=True).click()
    page.get_by_label("Reference for the geometry").fill("../other.tif")
    press(page, "Preview")
    page.get_by_role("alert").get_by_text("lies outside the folder").wait_for()
    reference = app.folder / "placed.png"
    x, y, width, height = PART
    truth = read_image(SAMPLE.with_name("chart_truth.png")).image[y : y + height, x : x + width]
    write_image(reference, truth, 8)
    try:
        page.get_by_label("Reference for the geometry").fill("placed.png")
        page.get_by_label("Grid of the result").click()
        page.get_by_role("option", name="1.5 times as fine").click()
        page.get_by_text("Astronomy").click()
        page.get_by_label("Turn a planet back").fill("pluto")
        press(page, "Run")
        page.get_by_role("alert").get_by_text("expected jupiter, saturn, mars or a period").wait_for()
        page.get_by_label("Turn a planet back").fill("")
        press(page, "Run")
        wait_for_result(page, "the finer image, of 288×216, is what is saved")
        page.locator("#right option", has_text="Finer").wait_for(state="attached")
        page.get_by_text("decisions").click()
        assert page.locator("dt").get_by_text("reference: ").is_visible()
        command = page.get_by_label("Command", exact=True).inner_text()
        assert shlex.split(command)[4:] == ["--frames=0:6", "--reference=placed.png", "--scale=1.5"]
    finally:
        reference.unlink()


def test_what_astronomers_choose_is_in_the_command(open_tab, app):
    from playwright.sync_api import expect

    dark = app.folder / "dark.png"
    write_image(dark, np.zeros((144, 192), np.float32), 8)
    page = open_tab()
    try:
        page.get_by_text("Astronomy").click()
        page.get_by_label("Dark frames").fill("/etc/passwd")
        press(page, "Preview")
        page.get_by_role("alert").get_by_text("lies outside the folder").wait_for()
        page.get_by_label("Dark frames").fill("dark.png")
        for side, value in zip(("x", "y", "width", "height"), (60, 40, 64, 48), strict=True):
            page.get_by_label(side, exact=True).fill(str(value))
        press(page, "Run")
        wait_for_result(page, "64×48 pixels from 48 frames in ")
        command = page.get_by_label("Command", exact=True).inner_text()
        assert shlex.split(command)[4:] == ["--roi=60,40,64,48", "--dark=dark.png"]
        press(page, "Whole frame")
        expect(page.get_by_label("width", exact=True)).to_have_value("")
        assert not page.get_by_role("button", name="Whole frame").is_visible()
    finally:
        dark.unlink()


def test_widths_are_compared_and_one_is_chosen(open_tab):
    page = open_tab()
    open_another(page, "small.mkv", 8)
    press(page, "Run")
    wait_for_result(page, "64×64 pixels from 8 frames")
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


def test_a_page_that_is_loaded_again_goes_on(open_tab, app):
    page = open_tab()
    draw(page, 0.25, 0.25, 0.5625, 0.6875)
    page.wait_for_function("document.querySelector('[aria-label=x]').value !== ''")
    page.get_by_label("last", exact=True).fill("23")
    begin_run(page)
    page.reload()
    done = page.get_by_text(" pixels from 24 frames in ")
    done.wait_for(timeout=LONG)
    words = done.inner_text()
    page.reload()
    wait_for_result(page, words)
    assert done.inner_text() == words
    # A busy browser asks late for images that are no longer kept.
    gone = page.locator("#stage img").first.get_attribute("src").replace("/stage", "/stage0")
    assert app.ask(urlsplit(app.address).path + gone) == 204
    page.evaluate("(gone) => turbrestore.replace('result', gone)", gone)
    push(page, "Width of the blur, pixels", "PageUp")
    page.get_by_text("press Apply for the whole image").wait_for(timeout=LONG)
    width = page.locator(".value").get_by_text(" px").inner_text()
    page.reload()
    page.get_by_text("press Apply for the whole image").wait_for(timeout=LONG)
    assert page.locator(".value").get_by_text(" px").inner_text() == width
    assert page.get_by_role("button", name="Apply to the whole").is_enabled()
    page.wait_for_function("document.querySelector('[aria-label=x]').value !== ''")
    page.get_by_label("Image, .png, .tif or .fits").fill("moon.fits")
    press(page, "Save")
    page.get_by_text("Saved: moon.fits, moon.fits.toml").wait_for(timeout=LONG)
    command = shlex.split(page.get_by_label("Command", exact=True).inner_text())
    image, settings = (app.folder / name for name in ("moon.fits", "moon.fits.toml"))
    used = tomllib.loads(settings.read_text())
    sigma = used["deconvolution"]["sigma"]
    assert (f"--sigma={sigma}" in command, used["frames"], image.stat().st_size > 0) == (True, "0:24", True)
    assert width == f"{sigma:.2f} px"
    image.unlink()
    settings.unlink()


def test_several_clips_and_a_steadied_video(open_tab, app):
    from playwright.sync_api import expect

    page = open_tab((900, 860))
    press(page, "Restore them")
    page.get_by_role("alert").get_by_text("choose some in the list").wait_for()
    for name in (EVIL, "small.mkv"):
        page.get_by_role("checkbox", name=name, exact=True).click()
    press(page, "Restore them")
    rows = page.locator(".rows tr")
    rows.nth(1).get_by_text("done: restored/small.png (").wait_for(timeout=LONG)
    assert rows.nth(0).inner_text().startswith(f"{EVIL}\tfailed: ") and page.title() == "turbrestore"
    try:
        assert {path.name for path in (app.folder / "restored").iterdir()} == {"small.png", "small.png.toml"}
        press(page, "Another clip")
        page.get_by_label("Path of a clip").fill("small.mkv")
        press(page, "Open")
        page.get_by_text("64×64 pixels").wait_for()
        assert page.get_by_label("Video, .mp4").input_value() == "small.steady.mp4"
        page.locator("details").filter(has_text="Reach").locator("summary").click()
        page.get_by_label("Reach, frames").fill("6")
        press(page, "Steady")
        playing = "document.querySelector('#film')?.readyState > 1 && document.querySelector('#film').videoWidth"
        page.wait_for_function(f"({playing}) === 128", timeout=LONG)
        command = page.get_by_label("Command of the video").inner_text()
        assert shlex.split(command) == ["turbrestore", "steady", "small.mkv", "small.steady.mp4", "--reach=6"]
        # What was written is not a clip to restore.
        assert "small.steady.mp4" not in page.get_by_label("Clips to restore").inner_text()
        page.locator("#stage").focus()
        page.keyboard.press(".")
        page.wait_for_function("document.querySelector('#frame-shown').textContent === '1'")
        grey = "(key) => document.querySelector(`[data-key=${key}] canvas`).toDataURL()"
        assert page.evaluate(grey, "input") != page.evaluate(grey, "output")
        page.reload()
        page.wait_for_function(f"({playing}) === 128", timeout=LONG)
        expect(page.get_by_label("Command of the video")).to_have_text(command)
        expect(page.get_by_label("Reach, frames")).to_have_value("6")
        rows.nth(1).wait_for()
        assert rows.count() == 2
        press(page, "Clip")
        page.locator("#stage").wait_for(state="detached")
        press(page, "Video")
        page.wait_for_function(f"({playing}) === 128", timeout=LONG)
    finally:
        shutil.rmtree(app.folder / "restored")
        for path in app.folder.glob("small.steady.*"):
            path.unlink()
    open_another(page, "chart.mkv", 48)
    expect(page.get_by_label("Command of the video")).to_be_hidden()
    expect(page.get_by_label("Reach, frames")).to_have_value("12")


def test_a_run_is_stopped_and_another_tab_goes_on(open_tab, app):
    # Long enough that it cannot end before it is stopped.
    write_video(app.folder / "long.mkv", np.concatenate([open_frames(SAMPLE, roi=(64, 48, 128, 96)).read()] * 8), 25)
    one, other = open_tab(), open_tab()
    open_another(one, "long.mkv", 384)
    # The frames are still being measured.
    one.get_by_label("last", exact=True).fill("382")
    begin_run(one)
    other.get_by_label("last", exact=True).fill("5")
    press(other, "Preview")
    press(one, "Stop")
    one.get_by_text("Stopped.", exact=True).wait_for(timeout=LONG)
    other.get_by_text("Preview of a part: 160×144 pixels from 6 frames").wait_for(timeout=LONG)
    one.get_by_role("button", name="Run", exact=True, disabled=False).wait_for()
    assert not one.get_by_role("heading", name="Tune").is_visible()
    assert one.get_by_label("last", exact=True).input_value() == "382"


def test_what_cannot_be_opened_is_said_in_one_line(open_tab, tmp_path):
    page = open_tab()
    alert = page.get_by_role("alert")
    press(page, "Another clip")
    press(page, EVIL)
    alert.get_by_text(f"{EVIL}: ").wait_for()
    assert page.title() == "turbrestore"
    assert "\n" not in alert.inner_text()
    outside = tmp_path / "clip.mkv"
    for name in (str(outside), "../elsewhere.mkv", "/proc/self/environ"):
        page.get_by_label("Path of a clip").fill(name)
        press(page, "Open")
        alert.get_by_text(re.compile(re.escape(name) + ": lies outside the folder")).wait_for()
    # No block of it is written or read.
    with (tmp_path / "large.mkv").open("wb") as file:
        file.truncate(8 * 2**30)
    page.locator("input[type=file]").set_input_files(tmp_path / "large.mkv")
    alert.get_by_text("upload: expected one clip of up to 2147483648 bytes").wait_for()
    (tmp_path / "large.mkv").unlink()
    page.get_by_label("Path of a clip").fill("images")
    press(page, "Open")
    page.locator(".name").get_by_text("images").wait_for()
    press(page, "Another clip")
    page.get_by_label("Path of a clip").fill("chart.mkv")
    press(page, "Open")
    page.get_by_role("button", name="Another clip").wait_for()
    assert not alert.is_visible()


def test_what_is_uploaded_goes_with_its_tab(open_tab, app):
    page = open_tab()
    before = set(app.temporary.iterdir())
    drop(page, "../\N{BULLET} elsewhere.mkv", SAMPLE.read_bytes())
    page.locator(".name").get_by_text("elsewhere.mkv").wait_for()
    # The server may still have the file that it received itself.
    (place,) = (path for path in set(app.temporary.iterdir()) - before if path.is_dir())
    assert [path.suffix for path in place.iterdir()] == [".mkv"]
    begin_run(page)
    page.close()
    assert soon(lambda: not place.exists())


def test_strangers_are_refused(app):
    here = urlsplit(app.address)
    assert app.ask() == 200
    assert app.ask("/") == app.ask("/pictures/a/1.png") == 404
    assert app.ask(f"{here.path[:-2]}/") == 404
    assert app.ask(f"{here.path}pictures/a/1.png") == app.ask(f"{here.path}videos/a/1.mp4") == 404
    assert app.ask(Host="elsewhere.example") == 403
    assert app.ask(method="POST", Content_Length=str(8 * 2**30)) == 413
