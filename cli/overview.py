"""The list of commands, which is shown at once: without a parser of command lines."""

from __future__ import annotations

import shutil
import textwrap

from .examples import FIRST_STEPS, epilogue

SUMMARY = "Restore one sharp image from a video of a static scene seen through atmospheric turbulence."
MOMENTS = "Estimate fast motion from slow sensors."
# Where each command lives, and what it says in one line.
COMMANDS = {
    "restore": ("restore:restore", "Restore one sharp image from a video."),
    "steady": ("steady:steady", "Steady and sharpen a video."),
    "register": ("register:register", "Write the frames registered, not stacked."),
    "batch": ("batch:batch", "Restore many videos side by side."),
    "align": ("align:align", "Align results to each other."),
    "report": ("report:report", "Write the report of a kept run."),
    "seeing": ("seeing:seeing", "Measure the strength of the turbulence."),
    "centroid": ("stages:centroid", "Find the centroid of a video."),
    "flow": ("stages:flow", "Measure the flow from an image to all frames."),
    "identify": ("stages:identify", "Identify the dynamics of flows."),
    "predict": ("stages:predict", "Predict a frame from the one before."),
    "filter": ("stages:filter_", "Filter with known centroid and dynamics."),
    "deconvolve": ("deblurring:deconvolve", "Deblur an image, or compare widths."),
    "synthesize": ("synthesis:synthesize", "Make a turbulent video with known truth."),
    "sample": ("sample:sample", "Write a small clip to try, with its truth."),
    "info": ("inspection:info", "Say what a video is."),
    "evaluate": ("inspection:evaluate", "Compare a result with the truth."),
    "app": ("app:app", "Choose, restore and tune a clip in the browser."),
    "config": ("config:config", "Write or check a settings file."),
    "doctor": ("doctor:doctor", "Check what this installation can do."),
    "moments wavefront": ("moments:wavefront", "A wavefront sensor that is exposed all the time."),
    "moments mirror": ("moments:mirror", "A steered mirror seen by a slow camera."),
    "--install-completion": ("completion:install_completion", "Complete words in bash, zsh or fish."),
}
# Options that the parser itself adds.
_ADDED = {"--help, -h": "Display this message and exit.", "--version": "Display application version."}


def overview() -> str:
    """Return what ``turbrestore --help`` prints."""
    texts = {words: summary for words, (_, summary) in COMMANDS.items() if " " not in words}
    rows = sorted({**texts, "moments": MOMENTS, **_ADDED}.items(), key=lambda row: (row[0].startswith("-"), row[0]))
    summary = textwrap.wrap(SUMMARY, shutil.get_terminal_size().columns)
    lines = ["Usage: turbrestore COMMAND", "", *summary, "", "", "Commands:"]
    return "\n".join([*lines, *(f"  {name:<30}{text}" for name, text in rows), "", epilogue(FIRST_STEPS)])
