"""Strength of the turbulence on small synthetic clips, and the remarks."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import scipy

import turbrestore
from turbrestore.footage.correction import Correction
from turbrestore.io.source import FrameSource
from turbrestore.io.video import write_video
from turbrestore.preparation import Prepared
from turbrestore.registration.centroid import Centroid, find_centroid
from turbrestore.seeing.displacement import Displacement
from turbrestore.seeing.strength import Seeing, chi_square_quantile, measure_seeing, seeing_of_picture
from turbrestore.seeing.tilt_theory import Optics
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import distort, smooth_flows
from turbrestore_cli.commands import run as run_command

OPTICS = Optics(2.75e-6, aperture=0.1, distance=2000.0)
STRENGTH, CN2 = 2.0, 3.56e-15


@pytest.fixture(scope="module")
def clip() -> tuple[np.ndarray, Centroid]:
    params = PhaseScreenParams(d_over_r0=STRENGTH, wind=(4.0,), wind_direction=(30.0,))
    made = phase_screen_frames(resolution_chart(96, 96), 32, np.random.default_rng(5), params)
    frames = np.stack([frame.image for frame in made])
    return frames, find_centroid(frames)


def measure(clip, **kwargs) -> Seeing:
    frames, centroid = clip
    return measure_seeing(frames, centroid.flows, centroid.image, frames.mean(axis=0), **kwargs)


def test_quantiles_are_those_of_scipy():
    for freedom in (0.3, 1, 1.5, 10, 278, 1e5):
        for share in (0.025, 0.975):
            exact = scipy.special.chdtri(freedom, 1 - share)
            assert chi_square_quantile(freedom, share) == pytest.approx(exact, rel=1e-9)


def test_strength_of_a_known_path(clip):
    seeing = measure(clip, optics=OPTICS)
    assert seeing.d_over_r0.value == pytest.approx(STRENGTH, rel=0.15)
    assert seeing.d_over_r0.low < STRENGTH < seeing.d_over_r0.high
    assert seeing.cn2.low < CN2 < seeing.cn2.high
    assert seeing.r0.value == pytest.approx(0.1 / seeing.d_over_r0.value)
    assert seeing.rotation < 0.3
    assert abs((seeing.wind_direction - 30 + 90) % 180 - 90) < 25
    # By blur and by flow the same, within the errors.
    assert seeing.displacement_by_blur.value == pytest.approx(seeing.displacement_by_flow.value, rel=0.25)
    assert not seeing.remarks


def test_without_a_distance_the_interval_is_wide_and_without_optics_there_is_no_strength(clip):
    far = measure(clip, optics=Optics(2.75e-6, aperture=0.1))
    assert far.cn2 is None
    assert far.d_over_r0.low < STRENGTH < far.d_over_r0.high
    assert far.d_over_r0.high / far.d_over_r0.low > 1.5
    plain = measure(clip)
    assert plain.d_over_r0 is None and plain.r0 is None and plain.displacement_variance is not None


def test_displacements_without_the_form_of_tilt_have_no_r0():
    rng = np.random.default_rng(0)
    frames = distort(resolution_chart(96, 96), smooth_flows(24, 96, 96, rng), rng, blur=0.7, noise=0.01)
    seeing = measure((frames, find_centroid(frames)), optics=OPTICS)
    assert seeing.d_over_r0 is None
    assert any("rotates as much as it diverges" in remark for remark in seeing.remarks)


def test_a_mean_that_is_blurred_more_than_the_flow_explains_is_remarked(clip):
    frames, centroid = clip
    mean = cv2.GaussianBlur(frames.mean(axis=0), (0, 0), 2.0)
    (remark,) = measure_seeing(frames, centroid.flows, centroid.image, mean).remarks
    assert "motion that the frames do not agree on" in remark
    (remark,) = measure_seeing(frames, centroid.flows, centroid.image, centroid.image).remarks
    assert "more motion than the mean shows" in remark


def test_a_still_clip_says_that_nothing_moves():
    frames = np.repeat(resolution_chart(64, 64)[None], 4, axis=0)
    seeing = measure_seeing(frames, np.zeros((4, 64, 64, 2), np.float32), frames[0], frames[0], OPTICS)
    assert seeing.displacement_variance is None and "too little structure or motion" in seeing.remarks[0]


def test_a_restoration_has_it_and_keeps_it(clip, tmp_path):
    restoration = turbrestore.restore(clip[0], turbrestore.RestoreParams(until="centroid"))
    assert restoration.seeing is not None
    assert [decision.choice for decision in restoration.decisions if decision.subject == "displacement"] == [
        "flow and blur agree"
    ]
    turbrestore.save_run(tmp_path / "run", restoration, turbrestore.RunRecord("clip", clip[0][0]))
    assert turbrestore.load_run(tmp_path / "run")[0].seeing == restoration.seeing


def moving_blocks(rng, frames, rho, spread=1.0, noise=0.0, side=8):
    """Displacement of blocks that move as a first-order process."""
    w = rng.normal(size=(frames, side, side, 2)) * np.sqrt(1 - rho**2)
    w[0] /= np.sqrt(1 - rho**2)
    for t in range(1, frames):
        w[t] += rho * w[t - 1]
    w = spread * w + noise * rng.normal(size=w.shape)
    return Displacement(w - w.mean(axis=0), np.ones((side, side), bool), 12, 12.0, noise**2)


def measure_blocks(found, monkeypatch) -> Seeing:
    monkeypatch.setattr("turbrestore.seeing.displacement.block_displacement", lambda *_: found)
    monkeypatch.setattr("turbrestore.seeing.displacement.rotation_share", lambda _: 0.1)
    still = np.full((2, 96, 96), 0.5, np.float32)
    return measure_seeing(still, np.zeros((2, 96, 96, 2), np.float32), still[0], still[0], OPTICS)


@pytest.mark.parametrize("rho", [0.95, 0.2])
def test_a_clip_of_few_correlation_times_has_no_upper_bound(rho, monkeypatch):
    inside, rng = 0, np.random.default_rng(6)
    for _ in range(10):
        seeing = measure_blocks(moving_blocks(rng, 40, rho), monkeypatch)
        inside += seeing.displacement_variance.low < 1 < seeing.displacement_variance.high
        slow = any("independent frames, so the variance is a lower bound" in remark for remark in seeing.remarks)
        assert slow is (rho > 0.9)
        for bounded in (seeing.displacement_variance, seeing.cn2, seeing.d_over_r0):
            assert np.isinf(bounded.high) == slow
        assert (seeing.r0.low == 0) is slow
        assert np.isfinite([seeing.cn2.low, seeing.cn2.value, seeing.r0.high]).all()
    assert inside >= 9


def test_noise_does_not_hide_the_wind(monkeypatch):
    spread = np.sqrt([3.0, 1.0])
    found = moving_blocks(np.random.default_rng(7), 60, 0.6, spread, noise=0.7)
    assert measure_blocks(found, monkeypatch).wind_anisotropy.value == pytest.approx(3.0, rel=0.25)


def test_r0_needs_neighbouring_blocks(monkeypatch):
    found = moving_blocks(np.random.default_rng(8), 40, 0.2)
    seeing = measure_blocks(found, monkeypatch)
    assert seeing.d_over_r0 is not None
    monkeypatch.undo()
    found.counts[1::2] = False
    monkeypatch.setattr("turbrestore.seeing.displacement.block_displacement", lambda *_: found)
    still = np.full((2, 96, 96), 0.5, np.float32)
    seeing = measure_seeing(still, np.zeros((2, 96, 96, 2), np.float32), still[0], still[0], OPTICS)
    assert seeing.d_over_r0 is None
    assert "too few neighbouring blocks" in seeing.remarks[-1]


def test_bars_do_not_count(clip):
    params = turbrestore.RestoreParams(until="centroid")
    barred = np.pad(clip[0], ((0, 0), (24, 24), (0, 0)), constant_values=0.06)
    found, alone = (turbrestore.restore(frames, params).seeing.displacement_variance for frames in (barred, clip[0]))
    assert found.value == pytest.approx(alone.value, rel=0.1)
    frames = np.pad(clip[0], ((0, 0), (24, 24), (0, 0)), mode="symmetric")
    prepared = Prepared(FrameSource.from_array(frames), (Correction((), picture=np.s_[24:-24, :]),))
    flows = np.pad(clip[1].flows, ((0, 0), (24, 24), (0, 0), (0, 0)), constant_values=3.0)
    image = np.pad(clip[1].image, ((24, 24), (0, 0)), mode="symmetric")
    within = seeing_of_picture(prepared.picture, frames, replace(clip[1], image=image, flows=flows))
    assert within == measure(clip)


def test_the_command_measures_what_a_restoration_does(clip, tmp_path, capsys):
    frames = np.rint(65535 * (0.107 + 0.006 * clip[0])).astype(np.uint16)
    np.save(tmp_path / "faint.npy", frames)
    assert run_command(["seeing", str(tmp_path / "faint.npy"), "--json", "--quiet"]) == 0
    printed = json.loads(capsys.readouterr().out)["displacement_variance"]
    source = FrameSource.from_array(frames)
    seeing = turbrestore.restore(source, turbrestore.RestoreParams(until="centroid", train=len(frames))).seeing
    assert printed["value"] == pytest.approx(seeing.displacement_variance.value, rel=1e-3)


def test_the_command_prints_every_value_with_its_interval(clip, tmp_path, capsys):
    video = tmp_path / "clip.mkv"
    write_video(video, clip[0], 30.0)
    words = ["seeing", str(video), "--pixel-scale=2.75e-6", "--aperture=0.1", "--distance=2000", "--quiet"]
    assert run_command([*words, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    for name in ("d_over_r0", "r0", "cn2", "displacement_variance", "displacement_by_blur"):
        assert printed[name]["low"] < printed[name]["value"] < printed[name]["high"]
    assert run_command(words) == 0
    assert "d over r0" in capsys.readouterr().out
    assert run_command(["seeing", str(video), "--aperture=0.1", "--quiet"]) == 2
    assert "--aperture: expected the angle of a pixel as well" in capsys.readouterr().err
