"""Beside the image: the clip as a steadied video, written into a file and compared with its input on the page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from nicegui import ui

from turbrestore.steady.settings import SteadyParams
from turbrestore_cli.options import Selection
from turbrestore_cli.steady import Output

from ..folders import printable
from ..steadying import SteadyOrder
from ..tab import Tab
from .elements import Command, Notices
from .progress_view import ProgressView

_CAMERAS = {"keep": "keep its motion", "steady": "smooth its motion", "lock": "lock it"}
_CODECS = {None: "H.264", "hevc": "HEVC, smaller files"}


class SteadyView:
    """What becomes of the camera, other options, the name of the video, and the command.

    Parameters
    ----------
    tab : Tab
    notices : Notices
    selection : callable
        Returns the frames and the region that are chosen.
    """

    def __init__(self, tab: Tab, notices: Notices, selection: Callable[[], Selection]) -> None:
        self._tab, self._notices, self._selection = tab, notices, selection
        self._progress, self._command = ProgressView(tab, "steady"), Command()
        self.follow = self._progress.follow

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section") as self.place:
            ui.html("Steadied video", tag="h2", sanitize=False)
            with ui.element("div").classes("fields"):
                self._camera = ui.select(_CAMERAS, label="Camera", value="keep").classes("grow")
                self._camera.props("dense outlined options-dense")
            with ui.element("details").classes("more"):
                ui.html("More options", tag="summary", sanitize=False)
                self._build_options()
            with ui.element("div").classes("fields"):
                self._path = ui.input("Video, .mp4").props("dense outlined").classes("grow")
            self._overwrite = ui.checkbox("Replace existing files").props("dense").classes("q-mt-sm")
            with ui.element("div").classes("fields"):
                button = ui.button("Steady", on_click=self._start).props("unelevated").classes("grow")
                self._progress.build((button,))
            self._progress.build_bars()
            self._command.build("Command of the video")

    def opened(self) -> None:
        """Start from what is usual, and suggest a name for the video of a new clip."""
        clip = self._tab.clip
        assert clip is not None
        self._fill(Path(f"{clip.name.stem}.steady.mp4"), SteadyParams(), Output(), overwrite=False)
        self._command.show("")

    def take_over(self, order: SteadyOrder) -> None:
        """Fill the fields by what a run had, and show its command."""
        clip, output = self._tab.clip, self._tab.folders.shown(order.output)
        assert clip is not None
        self._fill(output, order.params, order.written, order.overwrite)
        self._command.show(order.command_line(clip.name, output))

    def _fill(self, output: Path, params: SteadyParams, written: Output, overwrite: bool) -> None:
        self._path.value = printable(output)
        self._camera.value, self._sigma.value = params.camera, params.sigma
        self._largest.value, self._reach.value = params.largest, params.reach
        self._codec.value, self._crf.value = written.codec, written.crf
        self._overwrite.value = overwrite

    def _build_options(self) -> None:
        with ui.element("div").classes("fields pair"):
            self._sigma = ui.number("Blur to remove, pixels", min=0, max=20, step=0.1, placeholder="estimated")
            self._largest = ui.number("Largest shift, pixels", min=0.1, step=0.5, placeholder="measured")
        with ui.element("div").classes("fields pair"):
            self._reach = ui.number("Reach, frames", min=1, max=60, step=1, format="%d")
            self._crf = ui.number("Quality, 0 best to 51", min=0, max=51, step=1, placeholder="14", format="%d")
        with ui.element("div").classes("fields"):
            self._codec = ui.select(_CODECS, label="Codec", value=None)
        for field in (self._sigma, self._largest, self._reach, self._crf, self._codec):
            field.props("dense outlined options-dense stack-label").classes("grow")

    def _params(self) -> SteadyParams:
        return SteadyParams(
            camera=self._camera.value,
            sigma=self._sigma.value,
            reach=int(self._reach.value or SteadyParams().reach),
            largest=self._largest.value,
        )

    def _start(self) -> None:
        with self._notices.catching():
            clip, name, tab = self._tab.clip, self._path.value or "", self._tab
            assert clip is not None
            order = SteadyOrder(
                clip.path,
                tab.folders.output(name),
                self._selection(),
                self._params(),
                Output(self._codec.value, None if self._crf.value is None else int(self._crf.value)),
                bool(self._overwrite.value),
            )
            order.check()
            tab.steady(order)
            self._command.show(order.command_line(clip.name, Path(name)))
