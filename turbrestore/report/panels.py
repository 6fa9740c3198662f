"""The plots of the report, with their captions and their descriptions for screen readers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..blur.posterior import BlurPosterior
from ..display.curves import plot_blur, plot_convergence, plot_frames, plot_over_frames
from ..display.maps import plot_disagreement, plot_displacements, plot_flow, plot_uncertainty
from ..display.spectra import plot_eigenvalues, plot_signal, plot_singular_values
from ..display.witnesses import plot_witnesses
from ..dynamics.flow_model import FlowDynamics
from ..filtering.alternating import Filtered
from ..results import Restoration
from ..runs.run_record import RunRecord
from .alignment import align_curves, align_map, take_title
from .detail import detail_spectrum
from .vector import inline_svg

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Panel:
    """One plot."""

    title: str
    svg: Markup  # the ``<svg>`` element
    caption: str  # what the plot shows, and what to look for
    is_map: bool  # whether it has the shape of the image; maps come before the curves
    is_special: bool = False  # whether only specialists look for it


def make_panel(figure: Figure, name: str, description: str, caption: str) -> Panel:
    """Prepare a figure for the page: align its axes with the others, and turn its title into text that wraps."""
    from markupsafe import Markup

    title = take_title(figure) or description
    is_map = bool(figure.axes[0].images)
    (align_map if is_map else align_curves)(figure)
    return Panel(title, Markup(inline_svg(figure, name, description)), caption, is_map)


def draw_panels(restoration: Restoration, run: RunRecord) -> list[Panel]:
    """Draw the plots of all stages that have run."""
    stages = [*_motion(restoration, run)]
    if restoration.dynamics is not None:
        stages += _dynamics(restoration.dynamics)
    if restoration.filtered is not None:
        stages += _filter(restoration.filtered)
    return [*_trust(restoration), *_detail(restoration), *(replace(panel, is_special=True) for panel in stages)]


def _trust(restoration: Restoration) -> Iterator[Panel]:
    """Draw where the image is to be trusted."""
    if restoration.uncertainty is not None:
        figure = plot_uncertainty(restoration.uncertainty, restoration.image)
        caption = "Where not to trust the result: bright means uncertain, and brightest also where nothing is known."
        yield make_panel(figure, "uncertainty", "Map of the standard deviation of every pixel", caption)
    if restoration.disagreement is not None and restoration.disagreement.any():
        figure = plot_disagreement(restoration.disagreement, restoration.image)
        caption = "Bright: the frames do not agree on the detail of the result, or it rings; the mean takes its place."
        yield make_panel(figure, "agreement", "Map of the share of the mean in the detail", caption)


def _detail(restoration: Restoration) -> Iterator[Panel]:
    """Draw how fine the detail is that the frames tell, and how wide its blur is."""
    found, posterior, blur = detail_spectrum(restoration), restoration.posterior, restoration.blur
    if found is not None:
        figure = plot_signal(found.frequencies, found.signal, found.noise, found.limit)
        caption = (
            "Power of the scene, with its blur, and of the noise (dashed) in the filtered image. The clip tells detail "
            f"up to {found.limit:.2f} cycles per pixel, where the noise is as strong; beyond, sharpening shows noise."
        )
        yield make_panel(figure, "signal", "Power of signal and noise at every frequency", caption)
    if posterior is not None:
        yield _witnesses(posterior)
    elif blur is not None:
        figure = plot_blur(blur.widths, blur.costs, blur.sigma, blur.uncertainty)
        caption = "The minimum is the estimated width; the band shows its uncertainty."
        yield make_panel(figure, "blur", "Cost of every width of the blur", caption)


def _motion(restoration: Restoration, run: RunRecord) -> Iterator[Panel]:
    centroid = restoration.centroid
    number = len(centroid.flows) // 2
    figure = plot_flow(centroid.flows[number], centroid.image, f"Displacement of training frame {number}")
    caption = "Flow from the centroid to one frame, over the faint image."
    yield make_panel(figure, "flow", "Map of the displacement of one frame", caption)
    figure = plot_displacements(centroid.flows, centroid.image)
    caption = "Over the training frames. Strokes show the direction of the largest motion."
    yield make_panel(figure, "spread", "Map of the standard deviation of the displacement", caption)
    tolerance = run.settings.get("centroid", {}).get("tolerance")
    figure = plot_convergence(centroid.mean_flow_sizes, tolerance)
    caption = "At the centroid the mean flow should vanish; what remains is the bias of the flow method."
    yield make_panel(figure, "convergence", "Mean flow in each iteration of the centroid", caption)


def _dynamics(dynamics: FlowDynamics) -> Iterator[Panel]:
    figure = plot_singular_values(dynamics.singular_values, dynamics.rank)
    caption = f"Coloured: the states of the flow model, which hold {100 * dynamics.energy_share:.1f} % of the variance."
    yield make_panel(figure, "singular", "Singular values of the flows", caption)
    figure = plot_eigenvalues(dynamics.eigenvalues)
    caption = "Inside the circle, motion decays. If all values lie on it, the model only repeats the training flows."
    yield make_panel(figure, "eigen", "Eigenvalues of the transition matrix and the unit circle", caption)


def _filter(filtered: Filtered) -> Iterator[Panel]:
    figure = plot_over_frames(
        {"Gain of the image": filtered.gains, "Innovation of the flow, pixels": filtered.innovations}
    )
    caption = "How much each frame changed the image, and the motion that the model did not predict."
    yield make_panel(figure, "filter", "Gain and innovation of each frame", caption)
    figure = plot_frames(filtered.sharpness, filtered.shares)
    caption = "Sharp frames have more weight. Dashed: the sharpness of the centroid, and equal weights."
    yield make_panel(figure, "frames", "Sharpness and share of each frame", caption)


def _witnesses(posterior: BlurPosterior) -> Panel:
    widths = {
        "motion": posterior.by_displacement,
        "variation": posterior.by_variation,
        "edges": posterior.by_image,
        "two tones": posterior.by_tones,
        "all": posterior.width,
    }
    widths = {name: found for name, found in widths.items() if np.isfinite(found).all()}
    figure = plot_witnesses(widths, posterior.removed)
    caption = "Each bar holds 68 % of the probability. Dashed: the width that is removed."
    return make_panel(figure, "witnesses", "Widths of the blur by each witness", caption)
