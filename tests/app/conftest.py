"""A server of the app, tabs of it in a browser, and what a person does in them."""

import base64
import contextlib
import http.client
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from conftest import make_sequence
from turbrestore.io.images.image_files import write_image
from turbrestore.io.video import open_frames, write_video
from turbrestore_app.job import Job

EVIL = "<img src=x onerror=document.title='taken'>.mkv"
SAMPLE = Path(__file__).parents[2] / "sample_data" / "chart.mkv"
# Of the sample clip, x, y, width, height: larger than what a preview shows.
PART = (32, 24, 192, 144)
# Milliseconds until a run must have ended, on a machine that does other things too.
LONG = 60_000
# No image of the page is one that the server does not have.
COMPLETE = "[...document.images].every((image) => !image.getAttribute('src') || image.naturalWidth > 0)"


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
        connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=60)
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
    write_video(folder / "chart.mkv", open_frames(SAMPLE, roi=PART).read(), 25)
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
    _, complaints = app.process.communicate(timeout=60)
    # A bug would have left its traceback.
    assert (app.process.returncode, complaints) == (130, "turbrestore: interrupted\n")
    assert list(temporary.iterdir()) == []
    made = {path.name for path in folder.iterdir() if path.is_file() and path.suffix != ".mkv"}
    assert made <= {f"{name}.png{suffix}" for name in ("saved", "again") for suffix in ("", ".toml")}


@pytest.fixture(scope="module")
def window(browser, app):
    """A window with a tab of the app that stays: others share its process, which has compiled the scripts."""
    with contextlib.closing(browser.new_context()) as window:
        load(window.new_page(), app)
        yield window


def load(page, app):
    page.goto(app.address)
    page.wait_for_function("document.querySelector('#frame img')?.naturalWidth > 0")
    page.locator("svg.quality").wait_for(state="attached")


@pytest.fixture
def open_tab(window, app):
    """Open a tab; afterwards nothing must have been complained of, and nobody else asked."""
    pages, complaints, addresses = [], [], []

    def open_one(size=(1280, 860), window=window):
        page = window.new_page()
        pages.append(page)
        page.on("console", lambda message: complaints.append(message.text))
        page.on("response", lambda answer: answer.status >= 400 and complaints.append(f"{answer.status} {answer.url}"))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: addresses.append(request.url))
        page.on("websocket", lambda opened: addresses.append(opened.url.replace("ws://", "http://")))
        page.set_viewport_size({"width": size[0], "height": size[1]})
        load(page, app)
        return page

    yield open_one
    for page in pages:
        if not page.is_closed():
            page.wait_for_function(COMPLETE)
        page.close()
    assert not complaints, "\n".join(complaints)
    assert [address for address in addresses if not address.startswith((app.address, "data:", "blob:"))] == []


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


def open_another(page, name, frames):
    """Open another clip of the list, which has so many frames."""
    press(page, "Another clip")
    press(page, name)
    page.locator(".sum").get_by_text(f", {frames} frames").wait_for()


def wait_for_result(page, words):
    """Wait for the first result of a page, and for the width of its blur and its command, which come after it."""
    page.get_by_text(words).wait_for(timeout=LONG)
    page.locator(".value").get_by_text(" px").wait_for()


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


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("start")
    write_video(folder / "clip.mkv", make_sequence(seed=5, count=6, size=64).frames, fps=25)
    (folder / "below").mkdir()
    (folder / "notes.txt").touch()
    return folder


@pytest.fixture
def held(monkeypatch):
    """Hold whatever begins to run until this event is set."""
    event, begin = threading.Event(), Job._run
    monkeypatch.setattr(Job, "_run", lambda *words: event.wait(60) and begin(*words))
    return event


def ended(job):
    job.join(60)
    assert job.state != "running"
    return job
