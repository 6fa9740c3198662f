"""Settings of every stage that make no sense: each is refused in one line that begins with its name."""

import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import NonlocalParams
from turbrestore.dynamics.dynamic_texture import DynamicsParams
from turbrestore.filtering.filter_records import FilterParams
from turbrestore.registration.centroid import CentroidParams
from turbrestore.registration.flow import DisParams, FarnebackParams, FlowParams
from turbrestore.registration.flow_methods.tvl1 import TvL1Params
from turbrestore.settings import RestoreParams
from turbrestore.steady.settings import SteadyParams
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.dynamic_texture import DynamicTextureParams
from turbrestore.synthesis.sequence import CameraParams
from turbrestore.synthesis.smooth_flow import SmoothFlowParams

NAN, INF = np.nan, np.inf
# Values of a setting by its name, for each set of settings.
WRONG = {
    FlowParams: {"method": ["sift"], "contrast_window": [-1, INF], "contrast_floor": [0]},
    DisParams: {"patch_size": [0], "patch_stride": [9, 40], "finest_scale": [9], "smoothness": [INF]},
    FarnebackParams: {"neighbourhood": [6]},
    TvL1Params: {
        **{name: [0] for name in ("attachment", "warps", "sweeps", "step", "levels", "batch")},
        **{"huber": [-1], "median": [2], "tolerance": [NAN]},
    },
    CentroidParams: {"mode": ["median"], "iterations": [0], "tolerance": [-1.0], "start": [-1]},
    DynamicsParams: {
        "rank": [-1],
        "energy": [0.0, 1.1],
        "max_rank": [-1],
        "frames_per_state": [0.5, INF],
        "ridge": [-0.1],
    },
    FilterParams: {
        **{"residual": ["half"], "inner_iterations": [0], "block": [0], "sharpness": [-1.0, NAN]},
        **{"image_noise": [0.0, 1e300], "image_drift": [-1.0], "prior_frames": [-1.0]},
    },
    DeconvolutionParams: {
        **{"method": ["magic"], "boundary": ["mirror"], "channels": ["red"], "sigma": [-1.0], "fidelity": [0.0, INF]},
        **{"iterations": [0], "tolerance": [-1.0]},
    },
    NonlocalParams: {
        **{"patch": [4], "search": [0, 103], "patch_sigma": [0.0], "nearest": [5], "best": [-1], "h": [0.0]}
    },
    RestoreParams: {"train": [1], "until": ["sharpen"], "keep_best": [0.0], "border": ["mirror"]},
    SteadyParams: {"camera": ["still"], "reach": [0], "sigma": [-1], "largest": [0]},
    SmoothFlowParams: {"rms": [-1.0], "correlation_length": [0.0], "persistence": [1.0]},
    DynamicTextureParams: {"residual": ["half"], "fit": ["fill"], "largest_modulus": [1.0, NAN]},
    CameraParams: {
        **{"frame_rate": [0.0], "exposure": [0.05, -0.01, NAN], "sub_frames": [0], "photons": [0.0, NAN, 1e30]},
        **{"read_noise": [-0.1], "bit_depth": [17]},
    },
    PhaseScreenParams: {
        **{"cn2": [-1e-15, 0.0], "r0": [NAN], "d_over_r0": [INF, 80.0], "aperture": [0.0], "distance": [-5.0]},
        **{"wavelength": [0.5], "outer_scale": [0.1], "inner_scale": [-1.0], "layers": [0], "wind": [(1.0, 2.0), ()]},
        **{"wind_direction": [(NAN,)], "ifov": [0.0, -1e-6, 1.0], "nyquist": [-1.0, 0.0], "field_spacing": [0]},
        **{"pupil_samples": [4]},
    },
}
# What more than one setting has to do with.
TOGETHER = [
    (NonlocalParams, {"best": 0, "nearest": 0}, "best: expected"),
    (NonlocalParams, {"search": 3, "best": 9}, "best: expected"),
    (NonlocalParams, {"search": 1, "best": 0}, "search: expected"),
    (RestoreParams, {"keep_best": 0.5, "until": "centroid"}, "keep_best: has no effect"),
    (PhaseScreenParams, {"channel_wavelengths": (6e-7, 5e-7, 0.0)}, "[a-z_]*wavelength"),
    (PhaseScreenParams, {"cn2": 1e-15, "r0": 0.1}, "cn2, r0: expected at most one"),
    (PhaseScreenParams, {"ifov": 1e-6, "nyquist": 1.0}, "ifov, nyquist: expected at most one"),
    (PhaseScreenParams, {"pupil_samples": 16, "d_over_r0": 5.0}, "pupil_samples: expected 23 to 256 at D/r0 = 5"),
]
ALONE = [
    (kind, {name: value}, f"{name}: expected")
    for kind, settings in WRONG.items()
    for name, values in settings.items()
    for value in values
]


@pytest.mark.parametrize(("kind", "settings", "words"), [*ALONE, *TOGETHER])
def test_is_refused_in_one_line_that_names_it(kind, settings, words):
    with pytest.raises(ConfigurationError, match=rf"\A{words}[^\n]*\Z"):
        kind(**settings)
