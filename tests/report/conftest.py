"""A short run whose names are hostile, its report, and what reads a report."""

import base64
import dataclasses
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.decision import Decision
from turbrestore.io.source import FrameSource
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.report import render_report
from turbrestore.runs.run_record import describe_run

EVIL = "<script>alert(1)</script>\"'&.mkv"
WIDE, NARROW = {"width": 1000, "height": 700}, {"width": 360, "height": 640}
QUICK = RestoreParams(centroid=CentroidParams(iterations=1))


@pytest.fixture(scope="session")
def frames():
    return make_sequence(seed=41, count=6, size=64, rms=0.8, blur=2.0).frames


@pytest.fixture(scope="session")
def whole(frames):
    found = restore(frames, QUICK)
    return dataclasses.replace(found, decisions=(Decision("rank", "3 states", "95 % of the <motion>"),))


@pytest.fixture(scope="session")
def run(frames):
    return dataclasses.replace(
        describe_run(FrameSource.from_array(frames, EVIL, fps=25.0), QUICK, ("turbrestore", "restore", EVIL, "o.png")),
        warnings=("alpha channel <ignored>",),
    )


@pytest.fixture(scope="session")
def page(whole, run):
    return render_report(whole, run)


@pytest.fixture
def open_page(browser, report):
    """Open the report; afterwards nothing must have been complained of, and nothing asked for but the file."""
    contexts, complaints, requests = [], [], []

    def call(size=WIDE, **options):
        contexts.append(browser.new_context(viewport=size, **options))
        page = contexts[-1].new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(report.as_uri())
        return page

    yield call
    for context in contexts:
        context.close()
    assert complaints == []
    assert {url for url in requests if not url.startswith("data:")} == {report.as_uri()}


class Elements(HTMLParser):
    """All elements with their attributes, and the text of those named."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.found, self.open, self.text = [], [], {}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag):
        while self.open.pop() != tag:
            continue

    def handle_data(self, data):
        if self.open:
            self.text.setdefault(self.open[-1], []).append(data)

    def values(self, name):
        return [attributes[name] for _, attributes in self.found if name in attributes]


def decoded(address):
    data = base64.b64decode(address.partition(",")[2])
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return pixels if pixels.ndim == 2 else pixels[..., ::-1]
