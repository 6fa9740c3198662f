"""All plots under one name: each takes plain arrays and returns a matplotlib figure."""

from .curves import plot_blur, plot_convergence, plot_filter, plot_frames, plot_objective, plot_over_frames
from .figure import new_figure
from .maps import plot_disagreement, plot_displacements, plot_flow, plot_images, plot_uncertainty
from .spectra import plot_dynamics, plot_eigenvalues, plot_prediction, plot_singular_values
from .witnesses import plot_transfer, plot_variation, plot_witnesses

__all__ = [
    "new_figure",
    "plot_blur",
    "plot_convergence",
    "plot_disagreement",
    "plot_displacements",
    "plot_dynamics",
    "plot_eigenvalues",
    "plot_filter",
    "plot_flow",
    "plot_frames",
    "plot_images",
    "plot_objective",
    "plot_over_frames",
    "plot_prediction",
    "plot_singular_values",
    "plot_transfer",
    "plot_uncertainty",
    "plot_variation",
    "plot_witnesses",
]
