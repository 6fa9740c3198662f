"""Figures show the numbers they are given."""

import base64
import dataclasses
import subprocess
import sys

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle
from matplotlib.quiver import Quiver

from conftest import make_sequence
from turbrestore.blur.estimation import BlurEstimate, estimate_blur
from turbrestore.core.decision import Decision
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.display.curves import plot_blur, plot_convergence, plot_frames, plot_objective, plot_over_frames
from turbrestore.display.figure import ACCENT, INK, REST
from turbrestore.display.maps import plot_displacements, plot_flow, plot_images
from turbrestore.display.preview import encode_image, preview
from turbrestore.display.spectra import plot_dynamics, plot_eigenvalues, plot_singular_values
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams

RNG = np.random.default_rng(3)
KNOWN_BLUR = DeconvolutionParams(sigma=1.0, iterations=20)
FLOWS = RNG.normal(size=(7, 40, 60, 2)).astype(np.float32)


def curves(axes, colour=ACCENT):
    return [line for line in axes.lines if line.get_color() == colour]


def vectors(axes):
    (quiver,) = (artist for artist in axes.collections if isinstance(artist, Quiver))
    return quiver


class TestMaps:
    def test_flow_is_drawn_in_place_and_enlarged_as_the_label_says(self):
        flow = np.zeros((40, 60, 2), np.float32)
        flow[..., 0], flow[..., 1] = 0.3, -0.4
        axes = plot_flow(flow).axes[0]
        arrows = vectors(axes)
        assert np.allclose([arrows.U, arrows.V], [[0.3], [-0.4]])
        # Row numbers grow downward on the axes, as they do in the image.
        assert axes.get_ylim()[0] > axes.get_ylim()[1]
        assert np.allclose(axes.images[0].get_array(), 0.5)
        factor = float(axes.get_xlabel().split("×")[1])
        spacing = np.diff(np.unique(arrows.Y))[0]
        assert factor * 0.5 == pytest.approx(spacing, rel=0.05)
        assert arrows.scale == pytest.approx(1 / factor, rel=0.05)

    def test_spread_and_its_axis(self):
        lengths = RNG.normal(size=(50, 1, 1, 1))
        along = np.array([0.6, 0.8])
        flows = lengths * along + np.zeros((1, 40, 60, 1)) + 7.0
        axes = plot_displacements(flows).axes[0]
        assert np.allclose(axes.images[0].get_array(), lengths.std(), rtol=1e-4)
        strokes = vectors(axes)
        assert np.allclose(strokes.U * along[1], strokes.V * along[0], atol=1e-5)
        assert np.allclose(np.hypot(strokes.U, strokes.V), lengths.std(ddof=1), rtol=1e-4)

    def test_image_shows_through_and_must_fit(self):
        image = np.zeros((40, 60, 3), np.float32)
        image[:, 30:] = 1
        axes = plot_flow(np.zeros((40, 60, 2)), image).axes[0]
        blend = axes.images[1].get_array()
        assert (blend[:, 45] > blend[:, 15] + 0.2).all()
        with pytest.raises(DataError, match="60×40 pixels as the flow, found 40×60"):
            plot_flow(FLOWS[0], np.zeros((60, 40)))

    def test_large_maps_are_reduced_and_keep_their_extent(self):
        axes = plot_displacements(np.zeros((2, 400, 1000, 2))).axes[0]
        assert max(axes.images[0].get_array().shape) == 320
        assert tuple(axes.images[0].get_extent()) == (-0.5, 999.5, 399.5, -0.5)

    @pytest.mark.parametrize(
        ("draw", "flow"),
        [(plot_flow, FLOWS), (plot_displacements, FLOWS[0]), (plot_displacements, FLOWS[:1])],
    )
    def test_other_shapes_are_refused(self, draw, flow):
        with pytest.raises(DataError, match="expected"):
            draw(flow)


class TestCurves:
    def test_kept_singular_values_are_coloured_and_rounding_is_left_out(self):
        values = np.array([9.0, 5.0, 2.0, 0.5, 1e-9])
        axes = plot_singular_values(values, 2).axes[0]
        (kept,), (rest,) = curves(axes), curves(axes, REST)
        assert kept.get_xydata().tolist() == [[1, 9], [2, 5]]
        assert rest.get_xydata().tolist() == [[3, 2], [4, 0.5]]
        assert "2 of 5" in axes.get_title(loc="left")

    @pytest.mark.parametrize("values", [np.zeros(0), np.zeros(4)])
    def test_nothing_moves(self, values):
        plot_singular_values(values, 0).savefig("/dev/null", format="svg")
        plot_eigenvalues(np.zeros(0)).savefig("/dev/null", format="svg")

    def test_eigenvalues_lie_about_the_unit_circle(self):
        values = np.array([0.9 + 0.3j, 0.9 - 0.3j, 1.4])
        axes = plot_eigenvalues(values).axes[0]
        assert curves(axes)[0].get_xydata().tolist() == [[0.9, 0.3], [0.9, -0.3], [1.4, 0]]
        (circle,) = (patch for patch in axes.patches if isinstance(patch, Circle))
        assert (circle.center, circle.radius) == ((0, 0), 1)
        assert axes.get_aspect() == 1
        assert axes.get_xlim()[1] > 1.4

    def test_both_of_the_dynamics(self):
        left, right = plot_dynamics([3.0, 1.0, 0.1], [0.5, -0.5]).axes
        assert (len(curves(left)[0].get_xdata()), len(curves(right)[0].get_xdata())) == (2, 2)

    def test_convergence_and_tolerance(self):
        axes = plot_convergence([0.8, 0.1], 0.2).axes[0]
        assert curves(axes)[0].get_xydata().tolist() == [[1, 0.8], [2, 0.1]]
        assert curves(axes, INK)[0].get_ydata()[0] == 0.2
        assert not curves(plot_convergence([0.8]).axes[0], INK)

    def test_frames_against_an_equal_share(self):
        sharpness, shares = np.array([0.9, 1.1, 1.0, 1.0]), np.array([0.1, 0.4, 0.25, 0.25])
        upper, lower = plot_frames(sharpness, shares).axes
        assert np.array_equal(curves(upper)[0].get_ydata(), sharpness)
        assert np.allclose(curves(lower)[0].get_ydata(), [0.4, 1.6, 1, 1])

    def test_long_runs_are_averaged_over_neighbours(self):
        gains = RNG.uniform(size=1801)
        upper, lower = plot_over_frames({"gains": gains, "ones": np.ones(1801)}).axes
        shown = curves(upper)[0]
        assert len(shown.get_xdata()) == 451
        assert shown.get_ydata()[1] == pytest.approx(gains[4:8].mean())
        assert shown.get_ydata()[-1] == gains[-1]
        assert np.allclose(curves(lower)[0].get_ydata(), 1)

    def test_frames_that_do_not_count_are_gaps(self):
        sharpness = np.full(1201, np.nan)
        sharpness[:4] = [1, np.nan, 3, 5]
        lower = plot_over_frames({"ones": np.ones(1201), "sharpness": sharpness}).axes[1]
        assert np.array_equal(curves(lower)[0].get_ydata()[:3], [2, 5, np.nan], equal_nan=True)
        assert np.isnan(curves(plot_frames([1, np.nan, 1], [0.5, 0, 0.5]).axes[0])[0].get_ydata()[1])

    def test_blur_and_its_band(self):
        figure = plot_blur([0.5, 1.0, 1.5], [0.5, 0.2, 0.4], 1.1, 0.25)
        axes = figure.axes[0]
        assert np.allclose(curves(axes)[0].get_ydata(), [0.3, 0, 0.2])
        assert curves(axes, INK)[0].get_xdata()[0] == 1.1
        box = axes.patches[0].get_extents().transformed(axes.transData.inverted())
        assert (box.x0, box.x1) == pytest.approx((0.85, 1.35))
        assert not plot_blur([0.5, 1.0], [0.5, 0.2], 1.1, np.inf).axes[0].patches

    def test_nothing_to_show_is_said(self):
        for figure in (plot_blur([], [], 0, np.inf), plot_objective([], [])):
            (text,) = figure.axes[0].texts
            assert "no" in text.get_text()

    def test_images_stand_side_by_side(self):
        left, right = plot_images({"mean": np.zeros((4, 6)), "result": np.full((4, 6, 3), 2.0)}).axes
        assert (left.get_title(loc="left"), right.get_title(loc="left")) == ("mean", "result")
        assert right.images[0].get_array().max() == 1


def test_notebooks_get_svg():
    assert "<svg" in plot_convergence([1.0])._repr_svg_()


def test_missing_matplotlib_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'matplotlib.*'$"):
        plot_convergence([1.0])


def test_pyplot_stays_out():
    code = (
        "import sys; from turbrestore.display.spectra import plot_dynamics\n"
        "plot_dynamics([2.0, 1.0], [0.5]).savefig('/dev/null', format='svg')\n"
        "print('matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def luminance(colour):
    channels = np.array(to_rgb(colour))
    linear = np.where(channels <= 0.03928, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("colour", [INK, ACCENT])
def test_colours_read_on_white_and_on_black(colour):
    on_white, on_black = 1.05 / (luminance(colour) + 0.05), (luminance(colour) + 0.05) / 0.05
    assert min(on_white, on_black) > 4


class TestResults:
    @pytest.fixture(scope="class")
    @classmethod
    def restoration(cls):
        frames = make_sequence(seed=42, count=5, size=64, rms=0.7).frames
        return restore(frames, RestoreParams(centroid=CentroidParams(iterations=1), deconvolution=KNOWN_BLUR))

    @pytest.fixture
    def results(self, restoration):
        found = [restoration, restoration.centroid, restoration.dynamics, restoration.filtered]
        return [*found, restoration.deconvolution, estimate_blur(restoration.filtered.image)]

    def test_each_draws_itself(self, results):
        for result in results:
            figure = result.plot()
            assert figure.axes, type(result)
            assert all(axes.has_data() for axes in figure.axes), type(result)

    def test_cards_are_small_and_hold_their_figures(self, results):
        wanted = ["5, 5 to train", "mean flow left", "states", "innovation", "1.00 pixels", "evidence"]
        for result, words in zip(results, wanted, strict=True):
            card = result._repr_html_()
            assert words in card
            # An interpreter prints a result in a few lines, and no arrays.
            assert len(repr(result)) < 1000
            assert len(card) < 40_000
            assert ("<img" in card) == (not isinstance(result, BlurEstimate))

    def test_decisions_stand_on_the_card_as_text(self, restoration):
        decided = dataclasses.replace(restoration, decisions=(Decision("blur", "<b>none</b>", "soft"),))
        assert "&lt;b&gt;none" in decided._repr_html_()
        assert "<b>" not in decided._repr_html_()

    def test_unknown_blur(self):
        blur = estimate_blur(np.full((32, 32), 0.5, np.float32))
        assert "not determined" in blur._repr_html_()
        assert blur.plot().axes[0].texts

    def test_thumbnails_are_reduced(self):
        card = preview("big", [], np.zeros((1000, 500, 3), np.float32))
        data = base64.b64decode(card.split("base64,")[1].split("'")[0])
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == (224, 112, 3)

    def test_an_image_that_a_format_cannot_hold(self):
        with pytest.raises(DataError, match="webp can hold, found 20000×2"):
            encode_image(np.zeros((2, 20_000), np.uint8), "webp")
