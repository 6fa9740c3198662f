"""Images and figures of a report."""

import dataclasses

import numpy as np
import pytest

from turbrestore.core.arrays import from_unit
from turbrestore.core.noise_spectrum import RINGS, NoiseSpectrum
from turbrestore.display.curves import plot_convergence, plot_over_frames
from turbrestore.display.maps import plot_flow
from turbrestore.display.spectra import plot_eigenvalues
from turbrestore.report import facts, pictures
from turbrestore.report.alignment import align_curves, align_map, take_title
from turbrestore.report.detail import detail_spectrum
from turbrestore.report.vector import inline_svg

from .conftest import Elements, decoded


class TestPictures:
    def test_all_are_lossless_or_none(self, monkeypatch):
        noise = np.random.default_rng(0).uniform(size=(120, 90)).astype(np.float32)
        images = {"frame": noise, "mean": noise**2, "result": np.zeros_like(noise)}
        exact = pictures.encode_gallery(images, 7)
        assert "lossless" in exact.encoding
        for picture, image in zip(exact.pictures, images.values(), strict=True):
            pixels = decoded(picture.address)
            assert (np.atleast_3d(pixels)[..., 0] == from_unit(image, 8)).all()
            assert (picture.width, picture.height) == (90, 120)
        assert [picture.title for picture in exact.pictures] == ["Frame 7", "Mean", "Result"]
        total = sum(len(picture.address) * 3 // 4 for picture in exact.pictures)
        monkeypatch.setattr(pictures, "_LOSSLESS_BYTES", total // 2)
        coarse = pictures.encode_gallery(images, 7)
        assert "quality 95" in coarse.encoding
        assert sum(len(picture.address) * 3 // 4 for picture in coarse.pictures) < total
        assert not (np.atleast_3d(decoded(coarse.pictures[0].address))[..., 0] == from_unit(noise, 8)).all()

    def test_all_show_what_a_cropped_result_shows(self, whole, run):
        cropped = dataclasses.replace(whole, image=whole.image[5:45, 3:53], crop=(3, 5, 50, 40))
        images = pictures.stages(cropped, run.frame)
        assert list(images) == ["frame", "mean", "centroid", "filtered", "result"]
        assert {image.shape for image in images.values()} == {(40, 50)}
        assert (images["mean"] == whole.mean[5:45, 3:53]).all()
        (fact,) = (fact for fact in facts.headline(cropped) if fact.name == "Sharpness")
        assert fact.value.startswith("×")

    def test_huge_images_are_reduced(self):
        gallery = pictures.encode_gallery({"result": np.zeros((30, 4096), np.float32)}, 0)
        assert (gallery.pictures[0].width, gallery.pictures[0].height) == (2048, 15)
        assert "reduced to 2048" in gallery.encoding

    def test_clips_that_use_a_small_part_of_the_scale_are_not_shown_black(self):
        ramp = np.tile(np.linspace(0.1, 0.11, 50, dtype=np.float32), (40, 1))
        gallery = pictures.encode_gallery({"mean": ramp, "result": ramp}, 0)
        assert "black is 0.09" in gallery.encoding and "white 0.11" in gallery.encoding
        assert pictures.encode_gallery({"result": 50 * ramp - 4.9}, 0).encoding == "8 bits, lossless"
        # A dark scene keeps its black, so that a background of zero stays black.
        assert "black is 0 and white 0.3" in pictures.encode_gallery({"result": 30 * ramp - 3}, 0).encoding

    def test_shadows_are_lifted_only_where_most_of_the_scene_lies_in_them(self):
        ramp = np.tile(np.linspace(0, 1, 256, dtype=np.float32), (40, 1))
        night = np.where(ramp > 0.98, np.float32(1), 0.12 * ramp)
        plain, dark = (pictures.encode_gallery({"result": image}, 0).stretch for image in (ramp, night))
        assert plain.exponent == 1.0
        # Of a ramp that reaches from .2 to .7 both ends become full.
        level = pictures.encode_gallery({"result": 0.2 + 0.5 * ramp}, 0).stretch
        assert level.slope * 0.2 + level.intercept == pytest.approx(0, abs=0.02)
        assert level.slope * 0.7 + level.intercept == pytest.approx(1, abs=0.02)
        # A bright disc on black is no scene in shadows.
        disc = np.where(ramp > 0.9, np.float32(0.8), np.float32(0))
        assert pictures.encode_gallery({"result": disc}, 0).stretch.exponent == 1.0
        assert 0.45 <= dark.exponent < 1

    def test_result_stands_once(self, whole, run):
        assert list(pictures.stages(whole, run.frame)) == ["frame", "mean", "centroid", "filtered", "result"]
        kept = dataclasses.replace(whole, image=whole.filtered.image.copy())
        assert list(pictures.stages(kept, run.frame)) == ["frame", "mean", "centroid", "result"]


def test_axes_of_all_figures_line_up():
    curves = [
        plot_convergence([0.8, 0.2], 0.1),
        plot_over_frames({"gain": [1.0, 0.5], "innovation": [0.2, 1200.0]}),
        plot_eigenvalues(np.array([0.5 + 0.5j, 0.5 - 0.5j])),
    ]
    maps = [plot_flow(np.full((24, 32, 2), size)) for size in (1.0, 1e-3)]
    for figures, align in ((curves, align_curves), (maps, align_map)):
        for figure in figures:
            assert "\n" not in take_title(figure)
            align(figure)
            figure.draw_without_rendering()
        boxes = [axes.get_window_extent() for figure in figures for axes in (figure.axes[-1], figure.axes[0])]
        heights = {figure.get_size_inches()[1] for figure in figures}
        assert len(heights) == 1
        assert len({round(box.x0, 3) for box in boxes[1::2]}) == len({round(box.y0, 3) for box in boxes[::2]}) == 1


def test_svg_has_no_styles_and_scoped_names():
    svg = inline_svg(plot_flow(np.ones((24, 32, 2)), np.zeros((24, 32))), "map", 'say "<this>"')
    assert svg.startswith('<svg role="img" aria-label="say &quot;&lt;this&gt;&quot;" viewBox=')
    elements = Elements(svg)
    assert not {"style", "metadata"} & {tag for tag, _ in elements.found}
    assert not elements.values("style")
    assert all(name.startswith("map-") for name in elements.values("id"))
    assert all(address.startswith(("#map-", "data:image/")) for address in elements.values("href"))
    assert "Displacement of one frame, pixels" in elements.text["text"]
    assert svg == inline_svg(plot_flow(np.ones((24, 32, 2)), np.zeros((24, 32))), "map", 'say "<this>"')


def test_detail_ends_where_the_noise_is_as_strong(whole):
    # White noise over a scene whose power falls as a Gaussian: both are known, and so is where they meet.
    rng, deviation, width = np.random.default_rng(0), 0.02, 1.5
    field = rng.standard_normal((160, 200))
    nu = np.hypot(*np.meshgrid(np.fft.fftfreq(200), np.fft.fftfreq(160)))
    transfer = np.exp(-2 * np.pi**2 * width**2 * nu**2)
    scene = np.fft.ifft2(np.fft.fft2(field) * transfer).real
    image = (scene + deviation * rng.standard_normal(scene.shape)).astype(np.float32)
    noise = NoiseSpectrum(np.full(len(RINGS), deviation**2), np.zeros(len(RINGS)), np.zeros(len(RINGS)))
    known = dataclasses.replace(
        whole, noise=noise, filtered=dataclasses.replace(whole.filtered, image=image), crop=(0, 0, 200, 160)
    )
    found = detail_spectrum(known)
    meet = np.sqrt(-np.log(deviation) / (2 * np.pi**2 * width**2))
    assert found.limit == pytest.approx(meet, abs=1.5 * RINGS[1])
    assert (found.signal[found.frequencies < meet - 2 * RINGS[1]] > found.noise[0]).all()
    assert detail_spectrum(dataclasses.replace(whole, noise=None)) is None
