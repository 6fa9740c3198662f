"""The app in a browser, from the opening of a clip to the saved image, as a person would use it."""

import base64
import contextlib
import http.client
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.io.images import write_image
from turbrestore.io.video import write_video
from turbrestore_cli.__main__ import main

EVIL = "<img src=x onerror=document.title='taken'>.mkv"
SAMPLE = Path(__file__).parents[2] / "sample_data" / "chart.mkv"
# Seconds until a run must have ended, on a machine that does other things too.
LONG = 60_000
pytestmark = pytest.mark.long


class App:
    """A server in a process of its own, in a folder with one good clip and one that is broken."""

    def __init__(self, folder: Path, temporary: Path):
        self.folder, self.temporary = folder, temporary
        words = [sys.executable, "-m", "turbrestore_cli", "app", "chart.mkv", "--no-browser"]
        environment = {**os.environ, "TMPDIR": str(temporary)}
        self.process = subprocess.Popen(
            words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
        )
        self.address = self.process.stdout.readline().strip()

    def ask(self, path="", method="GET", **headers):
        """Status of the answer to a request."""
        parts = urlsplit(self.address)
        connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)
        connection.putrequest(method, path or parts.path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        status = connection.getresponse().status
        connection.close()
        return status


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    folder, temporary = tmp_path_factory.mktemp("start"), tmp_path_factory.mktemp("temporary")
    shutil.copy(SAMPLE, folder)
    (folder / EVIL).write_bytes(SAMPLE.read_bytes()[:3000])
    write_video(folder / "small.mkv", make_sequence(seed=4, count=8, size=64).frames, 25)
    (folder / "images").mkdir()
    for number, frame in enumerate(make_sequence(seed=3, count=4, size=64).frames):
        write_image(folder / "images" / f"{number}.png", frame, 8)
    # Not every file system takes a name that is no text.
    with contextlib.suppress(OSError):
        (folder / os.fsdecode(b"broken\xff.mkv")).touch()
    app = App(folder, temporary)
    yield app
    if app.process.poll() is None:
        app.process.send_signal(signal.SIGINT)
    _, complaints = app.process.communicate(timeout=20)
    # A bug would have left its traceback.
    assert (app.process.returncode, complaints) == (130, "turbrestore: interrupted\n")
    assert list(temporary.iterdir()) == []
    made = {path.name for path in folder.iterdir() if path.is_file() and path.suffix != ".mkv"}
    assert made <= {f"{name}.png{suffix}" for name in ("saved", "again") for suffix in ("", ".toml")}


@pytest.fixture
def open_tab(browser, app):
    """Open a tab; afterwards nothing must have been complained of, and nobody else asked."""
    contexts, complaints, addresses = [], [], []

    def call(size=(1280, 860), **options):
        contexts.append(browser.new_context(viewport={"width": size[0], "height": size[1]}, **options))
        page = contexts[-1].new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: addresses.append(request.url))
        page.on("websocket", lambda opened: addresses.append(opened.url.replace("ws://", "http://")))
        page.goto(app.address)
        page.locator("#frame img").wait_for()
        page.locator("svg.quality").wait_for(state="attached")
        return page

    yield call
    for context in contexts:
        context.close()
    assert complaints == []
    assert [address for address in addresses if not address.startswith((app.address, "data:", "blob:"))] == []


def pixels(element):
    return cv2.imdecode(np.frombuffer(element.screenshot(), np.uint8), cv2.IMREAD_COLOR).astype(int)


def draw(page, left, top, right, bottom):
    """Draw a region, in shares of the frame."""
    box = page.locator("#frame").bounding_box()
    x, y = ([box[start] + share * box[length] for share in ends] for start, length, ends in (
        ("x", "width", (left, right)), ("y", "height", (top, bottom))
    ))  # fmt: skip
    page.mouse.move(x[0], y[0])
    page.mouse.down()
    page.mouse.move(x[1], y[1], steps=3)
    page.mouse.up()


def push(page, name, key):
    """Move a slider by the keyboard."""
    page.get_by_role("slider", name=name, exact=True).locator("[tabindex='0']").press(key)


def press(page, name):
    page.get_by_role("button", name=name, exact=True).click()


def drop(page, name, data):
    """Drop a file anywhere on the page."""
    dragged = """([name, data]) => {
      const dragged = new DataTransfer();
      dragged.items.add(new File([Uint8Array.from(atob(data), (sign) => sign.charCodeAt(0))], name));
      return dragged;
    }"""
    files = page.evaluate_handle(dragged, [name, base64.b64encode(data).decode()])
    page.dispatch_event(".view", "dragenter", {"dataTransfer": files})
    page.get_by_text("Drop the clip to open it").wait_for()
    page.dispatch_event(".view", "drop", {"dataTransfer": files})


def test_from_the_clip_to_the_saved_image(open_tab, app, monkeypatch):
    page = open_tab(permissions=["clipboard-read", "clipboard-write"])
    assert page.get_by_text("256×192 pixels, 8 bits, 48 frames, 1.9 s at 25 per second").is_visible()
    before = pixels(page.locator("#frame"))
    address = page.locator("#frame img").get_attribute("src")
    push(page, "Frame", "PageDown")
    page.wait_for_function(f"!document.querySelector('#frame img').src.endsWith('{address}')")
    page.wait_for_timeout(100)
    assert (pixels(page.locator("#frame")) != before).any()

    draw(page, 0.25, 0.25, 0.5625, 0.6875)
    page.wait_for_function("document.querySelector('[aria-label=x]').value !== ''")
    sides = [int(page.get_by_label(name, exact=True).input_value()) for name in ("x", "y", "width", "height")]
    assert sides == pytest.approx([64, 48, 80, 84], abs=1)
    press(page, "Run")
    page.get_by_text(f"{sides[2]}×{sides[3]} pixels from 48 frames").wait_for(timeout=LONG)
    assert page.locator("#right option").all_inner_texts() == ["Frame", "Mean", "Centroid", "Filtered", "Result"]
    page.get_by_text("decisions").click()
    assert page.locator("dt").get_by_text("blur: ").is_visible()

    stage, before = page.locator("#stage"), pixels(page.locator("#stage"))
    begun = time.monotonic()
    push(page, "Width of the blur, pixels", "PageUp")
    # On a quick machine the exact one is there before the page is looked at.
    page.get_by_text(re.compile("the exact one follows|press Apply for the whole")).first.wait_for()
    assert time.monotonic() - begun < 10
    page.get_by_text("press Apply for the whole image").wait_for()
    page.wait_for_timeout(200)
    middle = before.shape[1] // 2
    changed = (pixels(stage) != before).any(axis=(0, 2))
    assert changed[middle + 20 :].any()
    assert not changed[: middle - 20].any()

    page.get_by_label("Image, .png, .tif or .fits").fill("saved.png")
    page.get_by_role("button", name="Copy command").first.click()
    page.get_by_text("The command is copied").wait_for()
    command = shlex.split(page.evaluate("navigator.clipboard.readText()"))
    press(page, "Save")
    page.get_by_text("Saved: saved.png, saved.png.toml").wait_for(timeout=LONG)
    assert command[:4] == ["turbrestore", "restore", "chart.mkv", "saved.png"]
    assert any(word.startswith("--sigma=") for word in command)
    monkeypatch.chdir(app.folder)
    assert main(["restore", "chart.mkv", "again.png", *command[4:], "--quiet"]) == 0
    assert Path("again.png").read_bytes() == Path("saved.png").read_bytes()
    assert Path("again.png.toml").read_bytes() == Path("saved.png.toml").read_bytes()

    press(page, "Save")
    page.get_by_role("alert").get_by_text("saved.png").wait_for()


def test_frames_are_chosen_by_the_strip_and_the_line(open_tab):
    page = open_tab()
    page.locator(".strip button").nth(1).click()
    page.locator(".view .value").get_by_text("9", exact=True).wait_for()
    page.get_by_text("Astronomy").click()
    page.get_by_label("last", exact=True).fill("39")
    page.get_by_text("40 of 40 frames are kept; drag the line").wait_for()
    graph = page.locator("svg.quality")
    graph.scroll_into_view_if_needed()
    box = graph.bounding_box()
    page.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 10)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 10, steps=4)
    page.mouse.up()
    page.get_by_text("12 of 40 frames are kept").wait_for()
    # The sharpest stand first, and the line behind the last that is kept.
    heights = graph.locator("rect").evaluate_all("(bars) => bars.map((bar) => Number(bar.getAttribute('height')))")
    assert len(heights) == 40 and heights == sorted(heights, reverse=True)
    level = graph.locator(".level").bounding_box()
    assert level["x"] - box["x"] == pytest.approx(0.3 * box["width"], abs=2)


def test_what_astronomers_choose_is_in_the_command(open_tab, app):
    from playwright.sync_api import expect

    dark = app.folder / "dark.png"
    write_image(dark, np.zeros((192, 256), np.float32), 8)
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
        page.get_by_text("64×48 pixels from 48 frames in ").wait_for(timeout=LONG)
        command = page.get_by_label("Command", exact=True).inner_text()
        assert shlex.split(command)[4:] == ["--roi=60,40,64,48", "--dark=dark.png"]
        press(page, "Whole frame")
        expect(page.get_by_label("width", exact=True)).to_have_value("")
        assert not page.get_by_role("button", name="Whole frame").is_visible()
    finally:
        dark.unlink()


def test_a_page_that_is_loaded_again_goes_on(open_tab, app):
    page = open_tab()
    draw(page, 0.25, 0.25, 0.5625, 0.6875)
    page.wait_for_function("document.querySelector('[aria-label=x]').value !== ''")
    press(page, "Run")
    page.get_by_text("s left").first.wait_for(timeout=LONG)
    page.reload()
    done = page.get_by_text(" pixels from 48 frames in ")
    done.wait_for(timeout=LONG)
    words = done.inner_text()
    page.reload()
    done.wait_for()
    assert done.inner_text() == words
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
    assert f"--sigma={float(width.split()[0])}" in command
    for name in ("moon.fits", "moon.fits.toml"):
        (app.folder / name).rename(app.temporary / name)
    try:
        with contextlib.chdir(app.folder):
            assert main([*command[1:], "--quiet"]) == 0
        for name in ("moon.fits", "moon.fits.toml"):
            assert (app.folder / name).read_bytes() == (app.temporary / name).read_bytes()
    finally:
        for folder in (app.folder, app.temporary):
            for path in folder.glob("moon.fits*"):
                path.unlink()


def test_several_clips_and_a_steadied_video(open_tab, app):
    page = open_tab((900, 860))
    press(page, "Restore them")
    page.get_by_role("alert").get_by_text("choose some in the list").wait_for()
    for name in (EVIL, "small.mkv"):
        page.get_by_role("checkbox", name=name, exact=True).click()
    press(page, "Restore them")
    rows = page.locator(".rows tr")
    rows.nth(1).get_by_text("done: restored/small.png, ").wait_for(timeout=LONG)
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
        assert rows.count() == 2
        press(page, "Clip")
        page.locator("#stage").wait_for(state="detached")
        press(page, "Video")
        page.wait_for_function(f"({playing}) === 128", timeout=LONG)
    finally:
        shutil.rmtree(app.folder / "restored")
        for path in app.folder.glob("small.steady.*"):
            path.unlink()


def test_a_run_is_stopped_and_another_tab_goes_on(open_tab):
    one, other = open_tab(), open_tab()
    press(one, "Run")
    one.get_by_text("s left").first.wait_for(timeout=LONG)
    press(other, "Preview")
    press(one, "Stop")
    one.get_by_text("Stopped.", exact=True).wait_for()
    other.get_by_text("Preview of a part: 160×160 pixels from 24 frames").wait_for(timeout=LONG)
    one.get_by_role("button", name="Run", exact=True, disabled=False).wait_for()
    assert not one.get_by_text("Tune", exact=True).is_visible()


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
    press(page, "Run")
    page.get_by_text("s left").first.wait_for(timeout=LONG)
    page.close()
    until = time.monotonic() + 30
    while place.exists() and time.monotonic() < until:
        time.sleep(0.1)
    assert not place.exists()


# Texts whose contrast with what is behind them is too low by WCAG AA; what is disabled may be.
FAINT = """() => {
  const channels = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const linear = (value) => value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const over = ([r, g, b, a = 1], [x, y, z]) => [a * r + (1 - a) * x, a * g + (1 - a) * y, a * b + (1 - a) * z];
  const parse = (colour) => {
    const context = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
    context.fillStyle = colour;
    context.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = context.getImageData(0, 0, 1, 1).data;
    return [r, g, b, a / 255];
  };
  const ground = (element) => {
    if (!element) return [255, 255, 255];
    const own = parse(getComputedStyle(element).backgroundColor);
    return own[3] === 1 ? own : over(own, ground(element.parentElement));
  };
  const faint = [];
  for (const element of document.querySelectorAll("body *")) {
    const style = getComputedStyle(element);
    const text = [...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    const idle = element.closest("[disabled], .disabled, [aria-disabled=true], figcaption, option");
    if (!text || idle || !element.checkVisibility({ visibilityProperty: true })) continue;
    const behind = ground(element), one = light(behind), other = light(over(parse(style.color), behind));
    const ratio = (Math.max(one, other) + 0.05) / (Math.min(one, other) + 0.05);
    if (ratio < 4.5) faint.push([element.textContent.trim().slice(0, 40), ratio.toFixed(2)]);
  }
  return faint;
}"""
# Name of what has the focus, and whether it, its field, its box or its bar looks other than without.
FOCUS = """() => {
  const element = document.activeElement;
  const name = element.ariaLabel || element.labels?.[0]?.textContent || element.closest("[aria-label]")?.ariaLabel;
  const within = element.querySelectorAll("[class*=track], [class*=bg]");
  const parts = [element, element.closest(".q-field__control") ?? element, ...within];
  const look = () => parts.map((part) => getComputedStyle(part)).map((style) => style.outline + style.boxShadow).join();
  const focused = look();
  element.blur();
  const plain = look();
  element.focus();
  return [element.tagName, (name || element.textContent).trim(), focused !== plain];
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_fits_every_window_in_both_schemes(open_tab, scheme):
    page = open_tab((1440, 900), color_scheme=scheme)
    for width, height in ((1440, 900), (1280, 860), (1024, 768), (899, 700), (768, 1024), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(150)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        cut = "(labels) => labels.map((label) => label.scrollWidth - label.clientWidth)"
        assert page.locator(".four .q-field__label").evaluate_all(cut) == [0] * 4
        parts = {
            name: page.locator(name).first.bounding_box() for name in ("#frame img", ".strip", "[aria-label=Frame]")
        }
        run = page.get_by_role("button", name="Run", exact=True).bounding_box()
        if width >= 900:
            # Without scrolling: the picture, its slider and the button.
            assert all(box["y"] >= 0 and box["y"] + box["height"] <= height for box in (*parts.values(), run))
            assert run["x"] > parts["#frame img"]["x"] + parts["#frame img"]["width"]
        else:
            assert run["y"] > parts["[aria-label=Frame]"]["y"] > parts["#frame img"]["y"]
        image = parts["#frame img"]
        assert image["width"] / image["height"] == pytest.approx(256 / 192, rel=0.02)
        assert image["width"] > 0.4 * width


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_everything_can_be_read_and_reached(open_tab, scheme):
    page = open_tab(color_scheme=scheme)
    page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
    page.add_style_tag(content="* { transition: none !important; }")
    page.wait_for_timeout(400)
    assert page.evaluate(FAINT) == []
    page.mouse.click(5, 5)
    reached = []
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.append(page.evaluate(FOCUS))
        if reached[-1][0] == "BODY":
            break
    stops = [stop for stop in reached if stop[0] != "BODY"]
    assert len(stops) > 30
    assert [stop for stop in stops if not stop[1] or not stop[2]] == []


def test_strangers_are_refused(app):
    here = urlsplit(app.address)
    assert app.ask() == 200
    assert app.ask("/") == app.ask("/pictures/a/1.png") == 404
    assert app.ask(f"{here.path[:-2]}/") == 404
    assert app.ask(f"{here.path}pictures/a/1.png") == app.ask(f"{here.path}videos/a/1.mp4") == 404
    assert app.ask(Host="elsewhere.example") == 403
    assert app.ask(Origin="http://elsewhere.example") == 403
    assert app.ask(method="POST", Content_Length=str(8 * 2**30)) == 413
    assert app.ask(method="POST", Transfer_Encoding="chunked") == 411
