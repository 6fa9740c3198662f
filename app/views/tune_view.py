"""Step three: other settings of the deconvolution, seen at once, then applied to the whole."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from nicegui import background_tasks, ui

from turbrestore.blur.psf import GAUSSIAN
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore_cli.deblurring import widths_of

from ..tab import Tab
from ..tuning import SLOW, automatic_fidelity, impressions, part_around, tuned_params
from .compare_view import CompareView
from .elements import Notices, in_thread, named_slider, set_most
from .sweep_view import SweepView

if TYPE_CHECKING:
    from turbrestore.core.arrays import FloatArray

_METHODS = {"nltv": "nonlocal total variation", "tv": "total variation", "wiener": "Wiener", "tikhonov": "Tikhonov"}
_BOUNDARIES = {"unknown": "unknown", "periodic": "repeats the image"}
_BORDERS = {"keep": "keep it", "crop": "crop what few frames show"}
# Logarithms of the smallest and the largest λ of the slider.
_FIDELITIES = (1.0, 5.0)


class TuneView:
    """Sliders of the deconvolution.

    Parameters
    ----------
    tab : Tab
    notices : Notices
    compare_view : CompareView
        Shows the part that is deblurred anew.
    sweep_view : SweepView
        Shows several widths side by side.
    on_change : callable
        Called when something was tuned.
    """

    def __init__(
        self,
        tab: Tab,
        notices: Notices,
        compare_view: CompareView,
        sweep_view: SweepView,
        on_change: Callable[[], None],
    ) -> None:
        self._tab, self._notices, self._on_change = tab, notices, on_change
        self._compare, self._sweep = compare_view, sweep_view
        self._setting = False
        self._wanted, self._working = 0, False
        self._automatic = True

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section") as self.place:
            ui.html('<span class="number">3</span> Tune', tag="h2", sanitize=False)
            self._sigma, self._sigma_text = named_slider("Width", 0, 6, 0.05, "Width of the blur, pixels")
            self._exponent, self._exponent_text = named_slider("Shape", 1, 2, 0.01, "Shape of the blur, exponent")
            self._fidelity, self._fidelity_text = named_slider(
                "Strength", *_FIDELITIES, 0.02, "Strength, the weight λ of the data, logarithm"
            )
            with ui.element("div").classes("fields"):
                self._widths = ui.input("Widths to compare, pixels", value="0.8, 1.2, 1.6, 2")
                self._widths.props("dense outlined").classes("grow").on("keydown.enter", self._compare_widths)
                ui.button("Compare widths", on_click=self._compare_widths).props("outline no-wrap")
            self._sigma.on_value_change(self._changed)
            self._exponent.on_value_change(self._changed)
            self._fidelity.on_value_change(self._weighed)
            with ui.element("div").classes("fields"):
                self._method = ui.select(_METHODS, label="Method", value="nltv", on_change=self._changed)
                self._method.props("dense outlined options-dense").classes("grow")
            with ui.element("div").classes("fields"):
                self._boundary = ui.select(
                    _BOUNDARIES, label="Scene beyond the border", value="unknown", on_change=self._changed
                )
            with ui.element("div").classes("fields"):
                self._border = ui.select(
                    _BORDERS, label="Border of the image", value="keep", on_change=self._border_changed
                )
            for select in (self._boundary, self._border):
                select.props("dense outlined options-dense").classes("grow")
            with ui.element("div").classes("fields apart"):
                self._apply = ui.button("Apply to the whole", on_click=self.apply).props("unelevated").classes("grow")
                self._reset = ui.button("As measured", on_click=self._measure).props("outline no-wrap")
            self._note = ui.label("").classes("note").props("role=status")

    def opened(self) -> None:
        """Show what was chosen: nothing for a new clip."""
        tab = self._tab
        self._automatic = tab.tuned is None or tab.tuned.fidelity is None
        self._border.value = tab.border
        self._on_change()

    async def restored(self) -> None:
        """Show the settings of a run that has ended, or what was chosen since and is not applied yet."""
        tab = self._tab
        assert tab.restored is not None
        if tab.tuned is None or not tab.pending:
            await self._show(tuned_params(tab.restored))
            return
        await self._show(tab.tuned)
        self._ask_for_part()

    def choose(self, sigma: float) -> None:
        """Set the width of the blur."""
        set_most(self._sigma, max(6.0, sigma))
        self._sigma.value = sigma

    def apply(self) -> None:
        """Deconvolve the whole image by what was chosen."""
        self._wanted += 1
        with self._notices.catching():
            self._tab.apply()

    async def _show(self, params: DeconvolutionParams) -> None:
        """Set the sliders without taking that for a wish of the user."""
        restored = self._tab.restored
        assert restored is not None
        self._automatic = params.fidelity is None
        measured = await in_thread(automatic_fidelity, restored, params)
        self._setting = True
        set_most(self._sigma, max(6.0, math.ceil(2 * (params.sigma or 0))))
        self._sigma.value = params.sigma or 0.0
        self._exponent.value = params.exponent or GAUSSIAN
        self._fidelity.value = min(max(math.log10(params.fidelity or measured), _FIDELITIES[0]), _FIDELITIES[1])
        self._method.value, self._boundary.value = params.method, params.boundary
        self._setting = False
        self._show_values()

    def _show_values(self) -> None:
        self._sigma_text.text = f"{self._sigma.value:.2f} px"
        self._exponent_text.text = f"{self._exponent.value:.2f}"
        self._fidelity_text.text = f"{10 ** (self._fidelity.value or 0):.0f}{', auto' if self._automatic else ''}"
        self._apply.set_enabled(self._tab.pending)
        self._on_change()

    def _border_changed(self) -> None:
        self._tab.border = self._border.value
        if self._tab.restored is not None:
            self._show_values()

    def _weighed(self) -> None:
        """Take λ from its slider from now on."""
        if not self._setting:
            self._automatic = False
        self._changed()

    def _changed(self) -> None:
        """Take over what the sliders say, and show what comes of it."""
        restored = self._tab.restored
        if self._setting or restored is None:
            return
        self._tab.tuned = dataclasses.replace(
            restored.order.params.deconvolution,
            sigma=round(float(self._sigma.value or 0), 3),
            exponent=round(float(self._exponent.value or GAUSSIAN), 3),
            fidelity=None if self._automatic else round(10 ** float(self._fidelity.value or 0), 1),
            method=self._method.value,
            boundary=self._boundary.value,
        )
        self._show_values()
        self._ask_for_part()

    def _ask_for_part(self) -> None:
        """Have the part shown by what is chosen now."""
        self._wanted += 1
        if not self._working:
            background_tasks.create(self._respond(), name="deblurring of a part")

    async def _respond(self) -> None:
        """Show the part by the newest settings; those that have changed meanwhile are not waited for."""
        self._working, answered = True, -1
        try:
            with self.place, self._notices.catching():
                while answered != self._wanted and self._tab.tuned is not None:
                    answered = self._wanted
                    await self._show_part(self._tab.tuned, answered)
        finally:
            self._working = False

    async def _show_part(self, params: DeconvolutionParams, number: int) -> None:
        restored = self._tab.restored
        if restored is None or self._tab.busy:
            return
        if self._automatic:
            await self._show(params)
        x, y, width, height = restored.restoration.crop
        across, down = await self._compare.middle()
        part = part_around(restored.frame.shape, x + across * width, y + down * height)
        begun = time.perf_counter()
        images = impressions(restored, params, part, lambda: number != self._wanted or self._tab.closed)
        rounds = 2 if params.method in SLOW else 1
        for count in range(1, rounds + 1):
            image = await in_thread(next, images, None)
            # Another clip may have been opened, or another result made.
            if image is None or restored is not self._tab.restored:
                return
            note = self._words(image, time.perf_counter() - begun, count < rounds)
            await self._compare.show_part(restored, part, image, note)

    def _words(self, image: FloatArray, seconds: float, more: bool) -> str:
        size = f"{image.shape[1]}×{image.shape[0]} pixels in {seconds:.2f} s"
        if more:
            return f"Quick preview of {size}; the exact one follows …"
        return f"{size}; press Apply for the whole image"

    async def _compare_widths(self) -> None:
        """Show several widths side by side, with the other settings as they are."""
        restored = self._tab.restored
        if restored is not None:
            with self._notices.catching():
                widths = widths_of(self._widths.value or "", restored.frame.shape, "Widths to compare")
                await self._sweep.show(restored, self._tab.tuned or tuned_params(restored), widths)

    async def _measure(self) -> None:
        """Go back to what is measured."""
        self._tab.tuned, self._automatic = None, True
        restored = self._tab.restored
        if restored is not None and self._tab.pending:
            self.apply()
        elif restored is not None:
            await self._show(tuned_params(restored))
