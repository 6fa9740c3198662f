"""How a run goes, beside the button that starts it: bars, what was decided, a button that stops it."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

from nicegui import ui

from turbrestore.core.remarks import counted
from turbrestore_cli.progress import TITLES

from ..tab import Tab
from .elements import labelled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..job import Bar, Job, Kind

_TITLES = {**TITLES, "film": "comparison for this page"}
_STATES = {"running": "Running …", "stopped": "Stopped.", "failed": "Failed."}


class ProgressView:
    """Progress of the runs of one kind.

    Parameters
    ----------
    tab : Tab
    kind : {"restore", "steady", "several", "live"}
        Runs that are shown; while another one is running, none can be started.
    """

    def __init__(self, tab: Tab, kind: Kind) -> None:
        self._tab, self._kind = tab, kind
        self._job: Job[object] | None = None
        self._ended = False
        self._bars: dict[str, tuple[ui.linear_progress, ui.label]] = {}

    def build(self, starters: Sequence[ui.button]) -> None:
        """Make the elements, after the buttons that start such a run; to be called in their row."""
        self._starters = starters
        self._stop = ui.button("Stop", on_click=self._tab.stop).props("outline")
        self._stop.visible = False

    def build_bars(self) -> None:
        """Make the elements below that row."""
        self._state = ui.label("").classes("note").props("role=status")
        self._stages = ui.element("div").classes("stages")
        self._decided = ui.html("", sanitize=False)
        self._show_nothing()

    def follow(self) -> Job[object] | None:
        """Show how the run goes; return it when it has just ended."""
        job = self._tab.job
        for button in self._starters:
            button.set_enabled(not self._tab.busy)
        if job is None or job.kind != self._kind:
            if self._job is not None:
                self._job = None
                self._show_nothing()
            return None
        if job is self._job and self._ended:
            return None
        if job is not self._job:
            self._job, self._ended = job, False
            self._clear()
        if self._bars.keys() - job.bars.keys():
            # The next of several clips.
            self._clear()
        # Once: it may end at any moment.
        state = job.state
        self._show_bars(job.bars.copy())
        self._show_decisions(job)
        self._stop.visible = state == "running"
        self._state.text = _finished(job, job.message) if state == "done" else _STATES[state]
        self._state.visible = True
        self._stages.visible = state != "done"
        self._ended = state != "running"
        return job if self._ended else None

    def show_tuned(self, pending: bool) -> None:
        """Take the verdict back while what is seen was tuned since the run, and bring it again."""
        job = self._job
        if job is not None and self._ended and job.state == "done" and job.message:
            told = "The verdict follows when what was tuned is applied." if pending else job.message
            self._state.text = _finished(job, told)

    def _show_nothing(self) -> None:
        self._clear()
        self._stop.visible = self._state.visible = self._stages.visible = self._decided.visible = False

    def _clear(self) -> None:
        self._bars.clear()
        self._stages.clear()
        self._decided.content = ""

    def _show_bars(self, bars: dict[str, Bar]) -> None:
        for stage, bar in bars.items():
            if stage not in self._bars:
                title = _TITLES[stage].capitalize()
                with self._stages, ui.element("div").classes("lap"):
                    ui.label(title)
                    left = ui.label("").classes("note")
                    line = ui.linear_progress(0, show_value=False, size="6px").props("instant-feedback")
                    line.props(f'aria-label="{title}"')
                self._bars[stage] = line, left
            line, left = self._bars[stage]
            line.value = round(bar.share, 3)
            seconds = bar.left
            left.text = "done" if bar.share == 1 else "" if seconds is None else f"{seconds:.0f} s left"

    def _show_decisions(self, job: Job[object]) -> None:
        decisions = tuple(job.decisions)
        lines = (
            f"<dt>{html.escape(decision.subject)}: {html.escape(labelled(decision.choice))}</dt>"
            f"<dd>{html.escape(labelled(decision.reason))}</dd>"
            for decision in decisions
        )
        shown = "" if job.state == "done" else " open"
        content = (
            f'<details class="decisions"{shown}><summary class="note">{counted(len(decisions), "decision")}</summary>'
            f'<dl class="decided">{"".join(lines)}</dl></details>'
        )
        self._decided.visible = bool(decisions)
        if self._decided.content != content:
            self._decided.content = content


def _finished(job: Job[object], told: str) -> str:
    """Say how long a run took, and what is to be told of it."""
    return f"Finished in {job.seconds:.1f} s. {labelled(told)}"
