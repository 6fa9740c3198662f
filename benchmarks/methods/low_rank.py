"""Registration to the mean, then a decomposition of the frames into background, turbulence and objects.

O. Oreifej, X. Li, M. Shah, *Simultaneous video stabilization and moving object detection in turbulence*, IEEE TPAMI
35(2), 450–462, 2013, for the decomposition; O. Oreifej, G. Shu, T. Pace, M. Shah, *A two-stage reconstruction approach
for seeing through water*, CVPR 2011, for the registration before it.

Symbols
-------
F : frames as columns, one row a pixel.
A, O, E : background (of low rank), moving objects (sparse), turbulence (dense and Gaussian).
τ, λ : weights of objects and turbulence.  Y, β : multiplier and penalty of the constraint.

Stage 1 registers the frames to their temporal mean and repeats that with the mean of the registered frames.  Before
every pass the frames are blurred until their mean gradient is that of the mean, so that like is compared with like; the
paper estimates a blur for the same purpose.  It registers by B-splines; here the optical flow of this project does.

Stage 2 solves::

    minimise  ‖A‖_* + τ ‖O‖_1 + λ ‖E‖_F²   subject to  F = A + O + E

by the augmented Lagrangian of the paper, in turn::

    A ← U S_{1/β}(Σ) Vᵀ           of  F − O − E + Y/β = U Σ Vᵀ
    O ← S_{τ/β}(F − A − E + Y/β)
    E ← (F − A − O + Y/β) / (1 + 2λ/β)
    Y ← Y + β (F − A − O − E),  β ← 1.25 β

with the shrinkage S_ε(x) = sign(x) max(|x| − ε, 0).  The paper weights O by a confidence that something moves, which a
scene at rest does not have.  The image is the mean of the background.

τ = 4/√m and λ = 1000/√m for m pixels are those of the demonstration in LRSLibrary (algorithms/ttd/3WD), which
carries the authors' implementation.  Four passes are what the paper of 2011 needs to converge.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.metrics import sharpness
from turbrestore.registration.flow import estimate_flow
from turbrestore.registration.warp import warp

# Widths of the Gaussian that frames are blurred by for registration, pixels.
BLURS = (0.0, 0.4, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0)
FIRST_PENALTY, PENALTY_GROWTH = 1.25, 1.25


@dataclass(frozen=True)
class LowRankParams:
    """Passes of the registration; τ√m, λ√m, iterations and tolerance of the decomposition."""

    passes: int = 4
    objects: float = 4.0
    turbulence: float = 1000.0
    iterations: int = 60
    tolerance: float = 1e-4


def low_rank_image(frames: FloatArray, params: LowRankParams | None = None) -> FloatArray:
    """Register frames (T, H, W[, 3]) to their mean and return the mean of their background."""
    params = params or LowRankParams()
    registered = register_to_mean(frames, params)
    background, _, _ = decompose(registered.reshape(len(frames), -1).T, params)
    return np.clip(background.mean(axis=1).reshape(frames.shape[1:]), 0, 1)


def register_to_mean(frames: FloatArray, params: LowRankParams | None = None) -> FloatArray:
    """Stage 1: the frames, each warped once, on the geometry of their mean."""
    params = params or LowRankParams()
    grey = [luminance(frame) for frame in frames]
    registered = frames
    for _ in range(params.passes):
        mean = registered.mean(axis=0)
        flows = estimate_flow(mean, _blurred_like(luminance(mean), grey))
        registered = np.stack([warp(frame, flow) for frame, flow in zip(frames, flows, strict=True)])
    return registered


def decompose(columns: FloatArray, params: LowRankParams | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Stage 2: background A, objects O and turbulence E of columns of shape (pixels, frames)."""
    params = params or LowRankParams()
    f = np.asarray(columns, np.float32)
    tau, weight = (w / float(np.sqrt(len(f))) for w in (params.objects, params.turbulence))
    norm = float(np.linalg.norm(f))
    spectral = float(np.sqrt(np.linalg.eigvalsh(f.T @ f)[-1]))
    beta = FIRST_PENALTY / spectral
    y = f / spectral
    o, e = np.zeros_like(f), np.zeros_like(f)
    for _ in range(params.iterations):
        a = _shrink_singular_values(f - o - e + y / beta, 1 / beta)
        o = _shrink(f - a - e + y / beta, tau / beta)
        e = (f - a - o + y / beta) / (1 + 2 * weight / beta)
        rest = f - a - o - e
        y += beta * rest
        beta *= PENALTY_GROWTH
        if np.linalg.norm(rest) <= params.tolerance * norm:
            break
    return a, o, e


def _blurred_like(mean: FloatArray, frames: list[FloatArray]) -> FloatArray:
    """Blur frames by the least of a few widths that makes them no sharper than their mean."""
    for width in BLURS:
        blurred = np.stack([cv2.GaussianBlur(frame, (0, 0), width) if width else frame for frame in frames])
        if np.mean([sharpness(frame, mean) for frame in blurred]) <= 1:
            break
    return blurred


def _shrink(values: FloatArray, threshold: float) -> FloatArray:
    return np.sign(values) * np.maximum(np.abs(values) - np.float32(threshold), 0)


def _shrink_singular_values(matrix: FloatArray, threshold: float) -> FloatArray:
    """Singular value thresholding of a tall matrix, by the eigenvectors of its small Gram matrix."""
    squares, vectors = np.linalg.eigh((matrix.T @ matrix).astype(np.float64))
    values = np.sqrt(np.maximum(squares, 0))
    gains = np.maximum(values - threshold, 0) / np.maximum(values, np.finfo(np.float32).tiny)
    return matrix @ ((vectors * gains) @ vectors.T).astype(np.float32)
