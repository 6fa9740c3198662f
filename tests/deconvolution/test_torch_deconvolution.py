"""Deconvolution in torch finds what it finds in NumPy; torch on the CPU stands in for a GPU."""

import cv2
import numpy as np
import pair_operators as pairs
import pytest
from blurred_images import psnr
from torch_devices import on_devices

from turbrestore.core.errors import ConfigurationError
from turbrestore.deconvolution.conjugate_gradient import ConjugateGradients
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.deconvolution.nonlocal_prior.nonlocal_tv import NonlocalPenalty
from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import NonlocalParams, nonlocal_weights
from turbrestore.deconvolution.nonlocal_prior.torch_nonlocal import torch_nonlocal_penalty
from turbrestore.deconvolution.primal_dual import WINDOW
from turbrestore.runtime.runtime import Runtime
from turbrestore.synthesis.scenes import SCENES, resolution_chart

SIZE = 72

GUIDES = {
    "chart": (resolution_chart(64, 70), NonlocalParams()),
    "noise": (np.random.default_rng(7).random((40, 33)).astype(np.float32), NonlocalParams(3, 1.0, 7, 4, 8)),
    "nearest": (np.random.default_rng(8).random((9, 14)).astype(np.float32), NonlocalParams(best=0)),
    "best": (np.random.default_rng(9).random((12, 13)).astype(np.float32), NonlocalParams(best=10, nearest=0)),
    "flat": (np.zeros((20, 20), np.float32), NonlocalParams(search=5)),
    "line": (np.linspace(0, 1, 8, dtype=np.float32)[None], NonlocalParams(patch=1, search=5, best=2, nearest=0)),
}


@on_devices
@pytest.mark.parametrize("name", GUIDES)
class TestWeights:
    def test_graph_is_that_of_the_cpu(self, device, name):
        here, there = nonlocal_weights(*GUIDES[name]), torch_nonlocal_penalty(*GUIDES[name], device)
        tails, heads, root = (array.cpu().numpy() for array in (there.tails, there.heads, there.root))
        order = np.lexsort([here.heads, pairs.tails(here)])
        assert (pairs.tails(here)[order] == tails).all()
        assert (here.heads[order] == heads).all()
        assert root**2 == pytest.approx(here.roots[order] ** 2, rel=1e-3, abs=1e-6)
        assert there.norm_squared == pytest.approx(here.norm_squared(), rel=1e-5)

    def test_the_penalty_is_that_of_the_cpu(self, device, name):
        import torch

        guide, params = GUIDES[name]
        here = NonlocalPenalty(nonlocal_weights(guide, params))
        there = torch_nonlocal_penalty(guide, params, device)
        rng = np.random.default_rng(10)
        u = rng.random(guide.shape).astype(np.float32)
        p = q = None
        for _ in range(3):
            u = rng.normal(size=guide.shape).astype(np.float32)
            p, adjoint = here.ascend(p, u, 0.7, 1.8)
            q, found = there.ascend(q, torch.from_numpy(u).to(device), 0.7, 1.8)
            assert found.cpu().numpy() == pytest.approx(adjoint, abs=5e-4)
        assert there.value(torch.from_numpy(u).to(device)) == pytest.approx(here.value(u), rel=1e-4)


def blurred(scene, sigma=1.5, seed=11):
    noise = np.random.default_rng(seed).normal(0, 0.005, scene.shape)
    return np.clip(cv2.GaussianBlur(scene, (0, 0), sigma) + noise, 0, 1).astype(np.float32)


@on_devices
class TestDeconvolution:
    @pytest.mark.parametrize(
        "settings",
        [
            {"method": "nltv"},
            {"method": "nltv", "sharpen_guide": False, "boundary": "periodic"},
            {"method": "tv"},
            {"method": "wiener"},
            {"method": "tikhonov", "boundary": "periodic"},
        ],
        ids=lambda settings: "-".join(map(str, settings.values())),
    )
    def test_image_and_record_are_those_of_the_cpu(self, device, settings):
        scene = SCENES["camera"](SIZE, SIZE + 3)
        image = blurred(scene)
        params = DeconvolutionParams(**settings)
        here = deconvolve(image, 1.5, params)
        there = deconvolve(image, 1.5, params, runtime=Runtime(device=device))
        assert abs(psnr(here.image, scene) - psnr(there.image, scene)) < 0.002
        assert np.abs(here.image - there.image).max() < 5e-3
        # Changes are measured over so many iterations.
        window = WINDOW if params.method in ("nltv", "tv") else ConjugateGradients.window
        assert abs(here.iterations - there.iterations) <= window
        assert there.converged == here.converged
        assert there.objective[-1] == pytest.approx(here.objective[-1], rel=1e-4)
        assert there.recorded[0] == here.recorded[0]
        assert there.changes[0] == pytest.approx(here.changes[0], rel=1e-2, abs=1e-6)

    @pytest.mark.parametrize("channels", ["luminance", "each"])
    def test_colour_and_a_guide(self, device, channels):
        scene = SCENES["camera"](SIZE, SIZE)[..., None] * np.array([0.9, 0.6, 0.3], np.float32)
        image, guide = blurred(scene), blurred(scene, seed=12)
        params = DeconvolutionParams(channels=channels, iterations=30)
        here, there = (deconvolve(image, 1.5, params, guide, Runtime(device=d)) for d in ("cpu", device))
        assert abs(psnr(here.image, scene) - psnr(there.image, scene)) < 0.002

    def test_a_sampled_blur(self, device):
        scene = SCENES["camera"](SIZE, SIZE)
        psf = np.zeros((5, 7))
        psf[2, 1:6] = 0.2
        image = np.clip(cv2.filter2D(scene, -1, psf), 0, 1)
        params = DeconvolutionParams(method="tv", iterations=40)
        here, there = (deconvolve(image, psf, params, runtime=Runtime(device=d)) for d in ("cpu", device))
        assert np.abs(here.image - there.image).max() < 1e-3

    def test_lack_of_memory_is_one_line(self, device, monkeypatch):
        def fail(*_):
            raise RuntimeError("CUDA out of memory.")

        monkeypatch.setattr("turbrestore.deconvolution.deconvolve.torch_nonlocal_penalty", fail)
        line = f"^device: the memory of '{device[:3]}.* is not enough; process a smaller part of the frame"
        with pytest.raises(ConfigurationError, match=line):
            deconvolve(SCENES["camera"](32, 32), 1.0, runtime=Runtime(device=device))
