"""Arguments of the public functions that are wrong: each is refused in one line that says what to pass instead."""

import numpy as np
import pytest

import turbrestore as tr

Y, X = np.mgrid[:32, :32]
FRAMES = np.stack([0.5 + 0.3 * np.sin((X + 0.3 * k) / 3) * np.cos(Y / 4) for k in range(4)]).astype(np.float32)
IMAGE, SOURCE = FRAMES[0], tr.FrameSource.from_array(FRAMES)
FLOWS = np.random.default_rng(0).normal(size=(4, 32, 32, 2)).astype(np.float32)
CENTROID = tr.Centroid(IMAGE, FLOWS, np.ones(1), True)
DYNAMICS = tr.identify(FLOWS)
HOLED = FRAMES.copy()
HOLED[3, 2, 1] = np.nan
TWO_SIZES = [IMAGE, IMAGE[:20]]
SCALE, RANGE = "divide them by full scale", r"expected values in 0 to 1, found [\d.]+ to \d{3}\S*"
FLOWS_EXPECTED = r"flows: expected flows \(T, H, W, 2\), found "
OPENED = r"use open_frames\(path\) or FrameSource\.from_array\(frames\)"

# Calls, and the lines that refuse them.
WRONG = {
    "path to restore": (
        lambda: tr.restore("clip.mkv"),
        r".* the path clip\.mkv; open it with turbrestore\.open_frames",
    ),
    "path of frames to filter_frames": (
        lambda: tr.filter_frames("clip.mkv", IMAGE, DYNAMICS),
        r"frames: expected arrays .* found the path clip\.mkv; open it with turbrestore\.open_frames",
    ),
    "path of frames to steady_frames": (
        lambda: next(tr.steady_frames("clip.mkv")),
        r"frames: expected arrays \(H, W\) or \(H, W, 3\), found the path clip.mkv",
    ),
    "no frames to filter_frames": (
        lambda: tr.filter_frames(None, IMAGE, DYNAMICS),
        r"frames: expected arrays \(H, W\) or \(H, W, 3\), found NoneType",
    ),
    "array to registered_frames": (
        lambda: next(iter(tr.registered_frames(FRAMES, tr.restore(FRAMES)))),
        f"source: expected FrameSource, found ndarray; {OPENED}",
    ),
    "frames of 255 to restore": (lambda: tr.restore(FRAMES * 255), f"array: frame 0: {RANGE}; {SCALE}"),
    "frames of 255 to find_centroid": (lambda: tr.find_centroid(FRAMES * 255), f"frames: {RANGE}; {SCALE}"),
    "frames of 255 to filter_frames": (
        lambda: tr.filter_frames(FRAMES * 255, IMAGE, DYNAMICS),
        f"frame 0: {RANGE}; {SCALE}",
    ),
    "reference of 255": (lambda: tr.filter_frames(FRAMES, IMAGE * 255, DYNAMICS), f"reference: {RANGE}; {SCALE}"),
    "frames of 255 to estimate_flow": (lambda: tr.estimate_flow(IMAGE, FRAMES * 255), f"frames: {RANGE}; {SCALE}"),
    "image of 255 to estimate_flow": (lambda: tr.estimate_flow(IMAGE * 255, FRAMES), f"reference: {RANGE}; {SCALE}"),
    "image of 255": (lambda: tr.deconvolve(IMAGE * 255, 1.0), f"image: {RANGE}; {SCALE}"),
    "guide of 255": (lambda: tr.deconvolve(IMAGE, 1.0, guide=IMAGE * 255), f"guide: {RANGE}; {SCALE}"),
    "frames of 255 to steady_frames": (lambda: next(tr.steady_frames(FRAMES * 255)), f"frame 0: {RANGE}; {SCALE}"),
    "width as text": (
        lambda: tr.deconvolve(IMAGE, "1"),
        "sigma_or_psf: expected a finite number of 0 or more pixels, found '1'",
    ),
    "width beyond the image": (
        lambda: tr.deconvolve(IMAGE, 500.0),
        "sigma_or_psf: expected at most the .* pixels of the longer side of the image, found 500",
    ),
    "a single frame": (
        lambda: tr.estimate_flow(IMAGE, IMAGE),
        r"frames: expected shape .*; write frame\[None\] for a single frame",
    ),
    "seed for a generator": (
        lambda: tr.phase_screen_frames(IMAGE, 4, 0),
        r"rng: expected Generator, found int; write np.random.default_rng\(0\)",
    ),
    "settings of another stage": (
        lambda: tr.deconvolve(IMAGE, 1.0, tr.FlowParams()),
        r"params: expected DeconvolutionParams, found FlowParams; write DeconvolutionParams\(\.\.\.\)",
    ),
    "dictionary": (
        lambda: tr.restore(FRAMES, {"sigma": 1}),
        r"params: expected RestoreParams, found dict; write RestoreParams\(\.\.\.\)",
    ),
    "flow settings first": (lambda: tr.find_centroid(FRAMES, tr.FlowParams()), "params: expected CentroidParams"),
    "flow settings": (lambda: tr.find_centroid(FRAMES, None, "dis"), "flow_params: expected FlowParams, found str"),
    "filter settings": (lambda: tr.filter_frames(FRAMES, IMAGE, DYNAMICS, 4), "params: expected FilterParams"),
    "model settings": (lambda: tr.identify(FLOWS, 3), "params: expected DynamicsParams, found int"),
    "settings of the flow": (lambda: tr.estimate_flow(IMAGE, FRAMES, "tvl1"), "params: expected FlowParams, found str"),
    "settings of a steady video": (lambda: next(tr.steady_frames(FRAMES, 5)), "params: expected SteadyParams"),
    "settings of registered frames": (
        lambda: next(iter(tr.registered_frames(SOURCE, tr.restore(FRAMES), {}))),
        "params: expected RestoreParams, found dict",
    ),
    "settings of the checks": (lambda: tr.check_content(SOURCE, True), "params: expected ContentParams, found bool"),
    "array to check_content": (
        lambda: tr.check_content(FRAMES),
        f"source: expected FrameSource, found ndarray; {OPENED}",
    ),
    "array to clean_source": (
        lambda: tr.clean_source(FRAMES, tr.check_content(SOURCE)),
        f"source: expected FrameSource, found ndarray; {OPENED}",
    ),
    "settings in place of a report": (
        lambda: tr.clean_source(SOURCE, tr.ContentParams()),
        r"report: expected ContentReport, found ContentParams; check_content\(source\) makes one",
    ),
    "flows in place of a model": (
        lambda: tr.filter_frames(FRAMES, IMAGE, FLOWS),
        r"dynamics: expected FlowDynamics, found ndarray; identify\(centroid\.flows\) finds them",
    ),
    "two sizes to restore": (
        lambda: tr.restore(TWO_SIZES),
        r"array: expected one shape, found \(32, 32\) beside \(20, 32\); crop them to one size",
    ),
    "two sizes to find_centroid": (
        lambda: tr.find_centroid(TWO_SIZES),
        r"frames: expected one shape, found \(32, 32\) beside \(20, 32\); crop them to one size",
    ),
    "path to find_centroid": (
        lambda: tr.find_centroid("clip.mkv"),
        r"frames: expected numbers, found the path clip\.mkv; open it with turbrestore\.open_frames",
    ),
    "path to deconvolve": (
        lambda: tr.deconvolve("a.png", 1.0),
        r"image: expected numbers, found the path a\.png; open it with turbrestore\.read_image",
    ),
    "source to find_centroid": (
        lambda: tr.find_centroid(SOURCE),
        r"frames: expected numbers, found FrameSource; use its \.read\(\)",
    ),
    "centroid as the reference": (
        lambda: tr.filter_frames(FRAMES, CENTROID, DYNAMICS),
        r"reference: expected numbers, found Centroid; use its \.image",
    ),
    "path to identify": (
        lambda: tr.identify("flows.npy"),
        rf"{FLOWS_EXPECTED}the path flows\.npy; read it with numpy\.load",
    ),
    "frames to identify": (lambda: tr.identify(FRAMES), rf"{FLOWS_EXPECTED}\(4, 32, 32\)"),
    "list of frames to identify": (lambda: tr.identify([*FRAMES]), rf"{FLOWS_EXPECTED}\(4, 32, 32\)"),
    "centroid to identify": (lambda: tr.identify(CENTROID), rf"{FLOWS_EXPECTED}Centroid; use its \.flows"),
    "holes": (
        lambda: tr.restore(HOLED),
        r"array: frame 3: expected finite values, found 1 NaN or infinite value; "
        r"clean_source\(source, check_content\(source\)\) fills them",
    ),
    "holes to find_centroid": (
        lambda: tr.find_centroid(HOLED),
        r"frames: expected finite values, found 1 NaN or infinite value; .* fills them",
    ),
    "share above 1": (
        lambda: tr.RestoreParams(keep_best=30),
        "keep_best: expected a share above 0 and up to 1, or 1% to 100%, found 30; write 0.3",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_is_refused_in_one_line_that_says_what_to_do(name):
    call, line = WRONG[name]
    with pytest.raises(tr.TurbrestoreError, match=rf"\A{line}[^\n]*\Z"):
        call()


def test_a_file_that_exists_names_the_argument_that_replaces_it(tmp_path):
    again = r"exists already; choose another name or pass overwrite=True\Z"
    tr.write_image(tmp_path / "a.png", IMAGE, 8)
    with pytest.raises(tr.TurbrestoreError, match=again):
        tr.write_image(tmp_path / "a.png", IMAGE, 8)
    tr.write_image(tmp_path / "a.png", IMAGE, 8, overwrite=True)
    tr.write_video(tmp_path / "a.mkv", FRAMES, 25)
    with pytest.raises(tr.TurbrestoreError, match=again):
        tr.write_video(tmp_path / "a.mkv", FRAMES, 25)


def test_the_images_of_the_stages_are_taken_although_splines_overshoot():
    frames = (np.median(FRAMES) < FRAMES).astype(np.float32)
    centroid = tr.find_centroid(frames)
    filtered = tr.filter_frames(frames, centroid.image, tr.identify(centroid.flows))
    assert filtered.image.max() > 1.05 and filtered.image.min() < -0.05
    assert tr.deconvolve(filtered.image, 1.0, tr.DeconvolutionParams(iterations=2), centroid.image).image.max() <= 1
    assert np.isfinite(tr.find_centroid(np.stack([centroid.image, filtered.image])).flows).all()


def test_what_the_refusal_of_holes_names_restores_the_frames():
    source = tr.FrameSource.from_array(HOLED)
    assert np.isfinite(tr.restore(tr.clean_source(source, tr.check_content(source))).image).all()
