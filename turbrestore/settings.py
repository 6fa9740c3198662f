"""The settings of a restoration, and the presets: named sets of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from .blur.psf import GAUSSIAN
from .core.errors import require, require_between
from .deblurring.guards import GuardParams
from .deconvolution.deconvolve import DeconvolutionParams
from .dynamics.dynamic_texture import DynamicsParams
from .filtering.alternating import FilterParams
from .footage.frame_selection import Share, check_share
from .registration.centroid import CentroidParams
from .registration.flow import FlowParams
from .registration.flow_methods.opencv_flow import DisParams
from .seeing.tilt_theory import Optics, known_optics

STAGES = ("centroid", "identify", "filter", "deconvolve")
BORDERS = ("keep", "crop")
_ALL = Share(1)

Preset = Literal["fast", "standard", "paper"]


@dataclass(frozen=True)
class RestoreParams:
    """Settings of every stage of a restoration.

    Parameters
    ----------
    train : int, optional
        Number of frames to learn the motion from.  They are the first ones, and tell the centroid and the dynamics of
        the flow.  By default all of up to 40 frames, else half of them, but at least 40 and at most 100.
    until : {"centroid", "identify", "filter", "deconvolve"}
        Last stage to run.
    keep_best : float
        Share of the frames to use, such as 30%.  The sharpest ones make the image, as in lucky imaging.
    border : {"keep", "crop"}
        Keep the border, or crop it.  Fewer frames show the scene there; what nine frames in ten show is left.
    static_mask : str
        A static overlay (a field stop, a reticle, a clock), which stays in place while the scene moves, is replaced by
        the scene behind it: auto finds it, off leaves it, and else it is the path of an image that is not black there.
        Moving objects are replaced too, unless it is off.
    pixel_scale : float, optional
        Angle of a pixel, rad.  With it and the aperture the blur by the air and by diffraction is better known, and the
        seeing is reported as D/r0 and r0.
    aperture : float, optional
        Diameter of the aperture, m.
    distance : float, optional
        From the aperture to the scene, m.  With it Cn² is reported too, and D/r0 is much better known.
    wavelength : float
        Wavelength of the light, m.
    psf : str, optional
        Image of a star or of a measured blur to remove, in pixels of the clip.  It takes the place of an estimated
        blur.
    reference : str, optional
        Image, or folder of a kept run, whose geometry the result has.  Its brightness and contrast may differ, as those
        of another filter or camera do.
    like : str, optional
        Flows of another recording of the same instants, which are applied as they are.  The folder of a kept run that
        trained on all of its frames, or the file of ``register --flows``.
    scale : float
        How much finer the grid of the result is, 1 to 3.  Frames are fused there by their motion of fractions of
        pixels, which gains detail where the lens is sharper than the pixels are small.
    flow : FlowParams
        Optical flow.
    centroid : CentroidParams
        Centroid iteration.
    dynamics : DynamicsParams
        Dynamic texture of the flow.
    filter : FilterParams
        Alternating-estimation Kalman filter.
    deconvolution : DeconvolutionParams
        Deconvolution.
    guards : GuardParams
        Limits that the deconvolved image must keep.

    Raises
    ------
    ConfigurationError
        A setting is out of range, or two settings contradict each other.

    Examples
    --------
    >>> RestoreParams(train=60, until="filter").border
    'keep'
    """

    train: int | None = None
    until: Literal["centroid", "identify", "filter", "deconvolve"] = "deconvolve"
    keep_best: Share = _ALL
    border: Literal["keep", "crop"] = "keep"
    static_mask: str = "auto"
    pixel_scale: float | None = None
    aperture: float | None = None
    distance: float | None = None
    wavelength: float = 550e-9
    psf: str | None = None
    reference: str | None = None
    like: str | None = None
    scale: float = 1.0
    flow: FlowParams = field(default_factory=FlowParams)
    centroid: CentroidParams = field(default_factory=CentroidParams)
    dynamics: DynamicsParams = field(default_factory=DynamicsParams)
    filter: FilterParams = field(default_factory=FilterParams)
    deconvolution: DeconvolutionParams = field(default_factory=DeconvolutionParams)
    guards: GuardParams = field(default_factory=GuardParams)

    def __post_init__(self) -> None:
        require(self.train is None or self.train >= 2, f"train: expected 2 frames or more, found {self.train}")
        require(self.until in STAGES, f"until: expected one of {', '.join(STAGES)}, found {self.until!r}")
        require(self.border in BORDERS, f"border: expected one of {', '.join(BORDERS)}, found {self.border!r}")
        for name, stage, is_usual in (
            ("deconvolution.sigma", "deconvolve", self.deconvolution.sigma is None),
            ("scale", "filter", self.scale == 1),
            ("keep_best", "filter", self.keep_best == 1),
        ):
            words = f"{name}: has no effect with until = {self.until}; leave one of them out"
            require(is_usual or self.runs(stage), words)
        require(
            self.psf is None or (self.until == STAGES[-1] and self.deconvolution.sigma is None),
            "psf: contradicts deconvolution.sigma, and until without a deconvolution; leave one of them out",
        )
        require(
            self.static_mask in ("auto", "off") or "." in self.static_mask,
            f"static_mask: expected auto, off or an image file, found {self.static_mask!r}",
        )
        require(
            self.reference is None or self.like is None,
            "like: its flows lead from a geometry of their own, which contradicts reference; leave one of them out",
        )
        require(
            self.like is None or self.filter.training == "filter",
            "like: expected filter.training = filter, because the known flows are those of all frames",
        )
        require_between("scale", self.scale, 1, 3)
        check_share(self.keep_best)
        known_optics(self.pixel_scale, self.aperture, self.wavelength, self.distance)

    @property
    def optics(self) -> Optics | None:
        """Camera and path of the clip, None if they are not known."""
        return known_optics(self.pixel_scale, self.aperture, self.wavelength, self.distance)

    @property
    def finds_blur(self) -> bool:
        """Whether a blur is removed, and is to be estimated."""
        return self.runs("deconvolve") and self.deconvolution.sigma is None and self.psf is None

    def runs(self, stage: str) -> bool:
        """Tell whether a stage is run.

        Parameters
        ----------
        stage : {"centroid", "identify", "filter", "deconvolve"}

        Returns
        -------
        bool

        Examples
        --------
        >>> RestoreParams(until="identify").runs("filter")
        False
        """
        return STAGES.index(stage) <= STAGES.index(self.until)


# ``standard`` lies where more time no longer gains quality, and ``fast`` gives up little of it to save a third of the
# time; ``benchmarks/flow_calls.py --presets`` shows both on the curve.  ``paper`` is paper 3 as it is printed, with
# this project's flow; there the width of the blur is chosen by hand, and here it is estimated where none is given.
PRESETS: Mapping[Preset, RestoreParams] = MappingProxyType(
    {
        "fast": RestoreParams(
            flow=FlowParams(dis=DisParams(finest_scale=2)),
            centroid=CentroidParams(iterations=2),
            filter=FilterParams(inner_iterations=1),
        ),
        "standard": RestoreParams(),
        "paper": RestoreParams(
            static_mask="off",
            centroid=CentroidParams(mode="single", iterations=10),
            filter=FilterParams(residual="drop", training="skip", block=1, sharpness=0.0, prior_frames=1.0),
            deconvolution=DeconvolutionParams(exponent=GAUSSIAN, sharpen_guide=False),
        ),
    }
)


def preset(name: Preset) -> RestoreParams:
    """Return a named set of settings.

    Parameters
    ----------
    name : {"fast", "standard", "paper"}
        ``standard`` is ``RestoreParams()``; ``fast`` takes three quarters of its time; ``paper`` is paper 3 as it is
        printed: one warped frame as the centroid, a filter that starts after the training frames from the last of
        their states, drops the flow outside the subspace and weighs all frames alike, and a Gaussian blur.  The paper
        chooses its width by hand, ``deconvolution.sigma``; it is estimated where none is given.

    Returns
    -------
    RestoreParams

    Raises
    ------
    ConfigurationError
        There is no such preset.

    Examples
    --------
    >>> from dataclasses import replace
    >>> replace(preset("fast"), train=60).filter.inner_iterations
    1
    """
    require(name in PRESETS, f"preset: expected one of {', '.join(PRESETS)}, found {name!r}")
    return PRESETS[name]
