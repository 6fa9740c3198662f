"""What several views need: the line for errors, sliders with a name and a value, and the command in a box."""

from __future__ import annotations

import asyncio
import html
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar, TypeVarTuple

from nicegui import ui

from ..folders import printable
from ..job import one_line

# What the page calls the options that errors, decisions and verdicts name; longer ones first.
_LABELS = {
    "pass overwrite=True": "tick Replace existing files",
    "leave out --sigma": "press As measured",
    "leave out --keep-best": "set Keep best to 100 %",
    "leave out --crop-to-object": "untick Follow a bright object on a dark field",
    "with --roi": "by Region",
    "--roi X,Y,WIDTH,HEIGHT of": "under Region, choose",
    "--roi X,Y,WIDTH,HEIGHT": "Region",
    "--frames FIRST:END with": "under Frames, choose",
    "--static-mask FILE": "the option static-mask of the command line",
    "--border crop": "Border of the image: crop what few frames show",
    "--reference": "Reference for the geometry",
    "--keep-best": "Keep best",
    "--overwrite": "Replace existing files",
    "--bit-depth": "Depth",
    "--axes thwc": "the option axes of the command line",
    "--axes thw": "the option axes of the command line",
    "--derotate": "Turn a planet back",
    "--hdr keep": "the option hdr of the command line",
    "--frames": "Frames",
    "try --bayer": "under Bayer pattern of a raw clip, choose",
    " or --bayer": " or",
    "--bayer": "Bayer pattern of a raw clip",
    "--sigma": "Width",
    "--scale": "Grid of the result",
    "--roi": "Region",
}

Arguments = TypeVarTuple("Arguments")
Result = TypeVar("Result")


class Notices:
    """The name of the clip, what the page waits for, and the newest error, in one line."""

    def build(self) -> None:
        """Make the elements."""
        with ui.element("header").classes("bar"):
            ui.html("turbrestore", tag="h1", sanitize=False)
            self._name = ui.label("no clip is open").classes("name")
            self._busy = ui.label("").classes("busy").props("role=status")
        self.error = ui.label("").classes("error").props("role=alert")
        self.error.visible = False

    def name(self, clip: object) -> None:
        """Show which clip is open."""
        self._name.text = printable(clip)

    @contextmanager
    def waiting(self, words: str) -> Iterator[None]:
        """Say what the page waits for."""
        self._busy.text = printable(words)
        try:
            yield
        finally:
            self._busy.text = ""

    @contextmanager
    def catching(self) -> Iterator[None]:
        """Show an error as one line; an earlier one disappears."""
        self.tell("")
        try:
            yield
        except Exception as error:
            self.tell(one_line(error))

    def tell(self, message: str) -> None:
        """Show one line above all, or none."""
        self.error.text = printable(labelled(message))
        self.error.visible = bool(message)


def labelled(message: str) -> str:
    """Name the fields of the page in place of the options that a message names."""
    # The page names the last frame, and the option the one behind it.
    message = re.sub(r"--frames (\d+):(\d+)", lambda ends: f"Frames {ends[1]} to {int(ends[2]) - 1}", message)
    for option, label in _LABELS.items():
        message = message.replace(option, label)
    return message


class Command:
    """A command line in a box, with a button that copies it."""

    def build(self, label: str) -> None:
        """Make the elements."""
        with ui.element("div").classes("copied") as self.place:
            self._box = ui.html("", tag="pre", sanitize=False).classes("command")
            self._box.props(f'tabindex=0 role=group aria-label="{label}"')
            self._button = ui.button("Copy command", on_click=self._copy).props("outline no-wrap")
            self._note = ui.label("").classes("note").props("role=status")
        self.show("")

    def show(self, words: str) -> None:
        """Show a command, or none."""
        self._words = printable(words)
        self._box.content = html.escape(self._words)
        self._note.text = ""
        self.place.visible = bool(words)

    def _copy(self) -> None:
        ui.clipboard.write(self._words)
        self._note.text = "The command is copied; run it in the folder where the app was started."


async def in_thread(function: Callable[[*Arguments], Result], *arguments: *Arguments) -> Result:
    """Return what a function returns in a thread; a page that was left meanwhile goes no further."""
    content = ui.context.client.content
    result = await asyncio.to_thread(function, *arguments)
    if content.is_deleted:
        raise asyncio.CancelledError
    return result


def named_slider(
    name: str, low: float, high: float, step: float, label: str, value: float | None = None
) -> tuple[ui.slider, ui.label]:
    """Make a slider between its name and its value."""
    with ui.element("div").classes("fields"):
        ui.label(name).classes("what")
        slider = ui.slider(min=low, max=high, step=step, value=low if value is None else value).classes("grow")
        slider.props(f'aria-label="{label}"')
        text = ui.label("").classes("value")
    return slider, text


def set_most(slider: ui.slider, most: float) -> None:
    """Set the largest value of a slider, before its value."""
    slider.props["max"] = most
    slider.update()
