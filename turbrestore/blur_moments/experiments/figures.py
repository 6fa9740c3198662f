"""Figures 4 to 7 of both papers, from the experiments: four panels in one picture, drawn with matplotlib."""

from __future__ import annotations

import importlib
import io
from typing import Any

import numpy as np

from ...core.extras import missing_package
from .comparison import Experiment

# Colour and dash of every observer, the same in all panels.
_STYLES = {"O1": ("tab:blue", "--"), "O2": ("tab:orange", ":"), "O3": ("tab:red", "-"), "image_map": ("tab:green", "-")}
# Duration of the overview, seconds.
_OVERVIEW = 5.0


def new_figure() -> Any:
    """Create an empty figure; called before a long computation, it shows whether matplotlib is installed."""
    try:
        # Loading the optional package by name lets type checkers run without it.
        return importlib.import_module("matplotlib.figure").Figure(figsize=(12, 8), layout="constrained")
    except ImportError as error:
        raise missing_package("plot", "matplotlib", "plot") from error


def draw_wavefront(experiment: Experiment) -> bytes:
    """Draw figures 4 to 7 of paper 1 as PNG.

    They show the estimates by the first and by the second moment, the error after every frame, the error at the fast
    rate, and the estimates within one exposure.
    """
    figure, panels = _four_panels("Wavefront sensor: slope θ, first seed")
    t, steps = _times(experiment), experiment.timing.frame_steps
    truth = experiment.truth.ravel()
    panels[0].plot(t, truth, "k", label="truth")
    for name in ("O1", "O2"):
        panels[0].plot(t, experiment.estimates[name].ravel(), **_style(name))
    _label(panels[0], "Figure 4: first or second moment alone", "time, s", "θ")
    for name in ("O1", "O3", "image_map"):
        panels[1].plot(experiment.errors[name], **_style(name))
        panels[2].plot(t, experiment.estimates[name].ravel() - truth, **_style(name))
    _label(panels[1], f"Figure 5: mean error, {experiment.seeds} seeds", "frame", "‖x̂ − x‖")
    _label(panels[2], "Figure 6: error at the fast rate", "time, s", "θ̂ − θ")
    last = slice(truth.size - steps, truth.size)
    panels[3].plot(t[last], truth[last], "k", label="truth")
    for name in ("O1", "O3", "image_map"):
        panels[3].plot(t[last], experiment.estimates[name].ravel()[last], **_style(name))
    _label(panels[3], "Figure 7: within one exposure", "time, s", "θ")
    return _png(figure)


def draw_mirror(experiment: Experiment) -> bytes:
    """Draw figures 4 to 7 of paper 2 as PNG.

    They show an overview with the exposures shaded, the frame period in which the error of O1 is the median, the error
    at the start of the exposures, and the error over the frame periods.  Estimates use the frame of their own period,
    which is available only after the readout.
    """
    figure, panels = _four_panels("Steered mirror: output y, first seed")
    t, steps, exposed = _times(experiment), experiment.timing.frame_steps, experiment.timing.exposure_steps
    shown = min(int(_OVERVIEW / experiment.timing.fast_period), t.size)
    size = np.linalg.norm(experiment.estimates["O1"] - experiment.truth, axis=1)
    typical = int(np.argsort(size)[len(size) // 2])
    for panel, part in ((panels[0], slice(0, shown)), (panels[1], slice(typical * steps, (typical + 1) * steps))):
        panel.plot(t[part], experiment.truth.ravel()[part], "k", label="truth")
        for name in ("O1", "O2", "O3"):
            panel.plot(t[part], experiment.estimates[name].ravel()[part], **_style(name))
        for start in range(part.start, part.stop, steps):
            panel.axvspan(t[start], t[min(start + exposed, t.size - 1)], color="0.9", zorder=0)
    _label(panels[0], "Figure 4: overview, exposures shaded", "time, s", "y")
    _label(panels[1], f"Figure 5: frame period {typical}", "time, s", "y")
    for name in ("O1", "O2", "O3"):
        away = np.abs(experiment.estimates[name] - experiment.truth)
        panels[2].plot(away[:, 0], **_style(name))
        panels[3].plot(np.sqrt((away**2).sum(1)), **_style(name))
    _label(panels[2], "Figure 6: error at the start of the exposures", "frame", "|ŷ − y|")
    _label(panels[3], "Figure 7: error over the frame period", "frame", "‖ŷ − y‖₂")
    return _png(figure)


def _four_panels(title: str) -> tuple[Any, list[Any]]:
    figure = new_figure()
    figure.suptitle(title)
    return figure, list(figure.subplots(2, 2).ravel())


def _times(experiment: Experiment) -> Any:
    timing = experiment.timing
    return timing.trigger + timing.fast_period * np.arange(experiment.truth.size)


def _style(name: str) -> dict[str, Any]:
    colour, dash = _STYLES[name]
    return {"color": colour, "linestyle": dash, "label": name.replace("_", " "), "linewidth": 1.2}


def _label(panel: Any, title: str, x: str, y: str) -> None:
    panel.set_title(title, fontsize=10, loc="left")
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    # Above the panel, beside the title, the legend covers nothing.
    panel.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, frameon=False, handlelength=1.5)


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
