"""Restore the same clips by methods of others and by this project, and print how they compare.

Run ``TURBRESTORE_DATA=DIR python benchmarks/peers.py --write benchmarks/results/peers.md``; without the folder only the
clips and the video that are made here are used.  Each method runs in a process of its own over all clips, one method
after the other.  Packages of others, and the network of one, run in environments that are made where there are none;
where that fails they are left out, with the reason.  ``--clips`` and ``--methods`` take names or patterns, ``--images``
writes the results of every clip side by side, ``--json`` the figures.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Mapping
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from clips import Clip, find_clips
from methods.deblurring import deblurred, levels_of
from methods.diffeomorphic import deblurred_template
from methods.low_rank import low_rank_image
from methods.packages import NETWORK, PACKAGES, PackageError, make_environment, run_package
from methods.sobolev import sobolev_latent_image
from methods.usage import peak_megabytes, processor_seconds
from peer_causes import try_others
from peer_tables import INSEPARABLE, READ, SAME, TURBRESTORE, Figures, Results, Trials, document
from peer_videos import measure_videos
from provenance import publish
from quality import panel
from revisions import child
from words import can_read, share_read

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import TurbrestoreError
from turbrestore.footage.frame_selection import best_frames, frame_quality
from turbrestore.footage.levels import Levels
from turbrestore.io.images.image_files import write_image
from turbrestore.io.output import atomic_write
from turbrestore.metrics import compare
from turbrestore.pipeline import restore

# Share of the frames that a lucky average keeps: as the stacker does here.
LUCKY = 0.5
# The network takes minutes for a clip, so it sees those that are drawn, and text.
NETWORK_CLIPS = ("drawn_*", "turbtext_pg*")
# What is compiled and loaded once does not count.
WARM = np.s_[:6, :64, :64]

Images = tuple[FloatArray, FloatArray | None]


def _turbrestore(frames: FloatArray) -> Images:
    restoration = restore(frames)
    filtered = restoration.centroid if restoration.filtered is None else restoration.filtered
    return filtered.image, restoration.image


def _sobolev(frames: FloatArray) -> Images:
    image = sobolev_latent_image(frames)
    return image, image


# Each returns the image that frames are merged into, and the same without its blur where the method has a way to it.
METHODS: dict[str, Callable[[FloatArray], Images]] = {
    "middle frame": lambda frames: (frames[len(frames) // 2], None),
    "mean": lambda frames: (frames.mean(axis=0), None),
    "median": lambda frames: (np.median(frames, axis=0), None),
    "lucky average": lambda frames: (frames[best_frames(frame_quality(frames), LUCKY)].mean(axis=0), None),
    "Sobolev flow": _sobolev,
    "low rank": lambda frames: (low_rank_image(frames), None),
    "template": deblurred_template,
    TURBRESTORE: _turbrestore,
}
MEANINGS = {
    "middle frame": "one frame as it is",
    "mean": "temporal mean",
    "median": "temporal median",
    "lucky average": f"mean of the sharper {LUCKY:.0%} of the frames",
    "PlanetarySystemStacker": "the stacker of that name, 0.9.8.2, with half of the frames",
    "pystackreg": "mean after bilinear registration of every frame to the mean by the package pystackreg 0.2.8",
    "Sobolev flow": "Sobolev gradient flow and lucky regions (Lou, Kang, Soatto, Bertozzi 2013), sharp by itself",
    "low rank": "registration to the mean and three-term decomposition (Oreifej, Li, Shah 2013)",
    "template": "diffeomorphic template (Lao, Wang, Wong, Soatto 2024), deblurred by a Gaussian of estimated width",
    NETWORK: "mean of frames that the first network of Turbulence Mitigation Transformer (Zhang, Mao, Chimitt, Chan "
    "2024) has de-tilted, with the weights in the package vs_undistort 2.3.1, whose licence is not stated",
    TURBRESTORE: "this project with its defaults; merged is its image before deconvolution",
}


def main() -> int:
    """Measure and print."""
    options = _options()
    try:
        chosen = [name for name in MEANINGS if any(fnmatch(name, pattern) for pattern in options.methods)]
        results, skipped, trials = measure_all(options.clips, chosen, options.images)
        networks = {NETWORK: PACKAGES[NETWORK].python} if results.get(NETWORK) else {}
        videos = {} if options.without_videos else measure_videos(networks)
    except TurbrestoreError as error:
        print(f"peers: {error}", file=sys.stderr)
        return error.exit_code
    text = document(results, {name: MEANINGS[name] for name in chosen}, skipped, videos, options.clips, trials)
    publish(text, options.write)
    if options.json is not None:
        figures = {"clips": results, "videos": videos, "skipped": skipped}
        atomic_write(options.json, (json.dumps(figures, indent=2) + "\n").encode(), overwrite=True)
    return 0


def measure_all(patterns: list[str], methods: list[str], images: Path | None) -> tuple[Results, dict[str, str], Trials]:
    """Figures of every method and clip, why methods are missing, and what other settings give."""
    clips = {name: load() for name, load in find_clips(patterns).items()}
    # Without a truth or words there is nothing to compare.
    clips = {name: clip for name, clip in clips.items() if clip.truth is not None or (clip.words and can_read())}
    spent: dict[str, dict[str, Figures]] = {}
    skipped: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for clip_name, clip in clips.items():
            np.save(folder / f"{clip_name}.npy", clip.frames)
        for method in methods:
            some = [one for one in clips if method != NETWORK or any(map(partial(fnmatch, one), NETWORK_CLIPS))]
            if not some:
                skipped[method] = "it runs on none of these clips"
                continue
            try:
                python = make_environment(PACKAGES[method]) if method in PACKAGES else None
                used = child(
                    __file__, {"method": method, "folder": name, "clips": some, "python": python and str(python)}
                )
            except PackageError as error:
                skipped[method] = str(error)
                continue
            if not used["clips"]:
                # Otherwise there would be no clip on which every method ended, and no mean.
                skipped[method] = next(iter(used["failed"].values()))
                continue
            skipped |= {f"{method} on {clip_name}": reason for clip_name, reason in used["failed"].items()}
            spent[method] = used["clips"]
        # After all environments are made, that of the second reader too.
        results = {
            method: {one: _figures(folder / f"{method}-{one}.npz", clips[one]) | used for one, used in found.items()}
            for method, found in spent.items()
        }
        trials = try_others(results, clips)
        if images is not None:
            _write_panels(images, folder, clips, [*results])
    return results, skipped, trials


def run_child(task: dict[str, Any]) -> dict[str, Any]:
    """Restore all clips by one method; images go beside the frames, the figures tell time and memory."""
    name, folder = task["method"], Path(task["folder"])
    spent: dict[str, Figures] = {}
    failed: dict[str, str] = {}
    warm = np.load(folder / f"{task['clips'][0]}.npy")[WARM]
    if name in METHODS:
        METHODS[name](warm)
    deblurred(warm.mean(axis=0), Levels())
    for clip in task["clips"]:
        frames = np.load(folder / f"{clip}.npy")
        begun = processor_seconds()
        try:
            if name in METHODS:
                merged, sharp = METHODS[name](frames)
                used = {"seconds": processor_seconds() - begun, "peak": peak_megabytes()}
            else:
                made, used = run_package(name, frames, Path(task["python"]))
                merged, sharp = made.mean(axis=0) if made.ndim == frames.ndim else made, None
        except TurbrestoreError as error:
            failed[clip] = str(error)
            continue
        if merged is sharp:
            used[INSEPARABLE] = 1.0
        if sharp is None:
            levels, begun = levels_of(frames), processor_seconds()
            sharp = deblurred(merged, levels).image
            used["seconds"] += processor_seconds() - begun
        spent[clip] = used
        np.savez(folder / f"{name}-{clip}.npz", merged=merged, sharp=sharp)
    return {"clips": spent, "failed": failed}


def _figures(path: Path, clip: Clip) -> Figures:
    """Quality of the merged image, and under names with a suffix of the deblurred one."""
    measured: Figures = {}
    with np.load(path) as images:
        for name, suffix in (("merged", ""), ("sharp", SAME)):
            image = images[name]
            if clip.truth is not None:
                found = compare(image, clip.truth)
                measured |= {f"psnr{suffix}": found.psnr, f"ssim{suffix}": found.ssim}
            if clip.centroid is not None:
                measured[f"centroid{suffix}"] = compare(image, clip.centroid).psnr
            for reader, figure in READ.items():
                if clip.words and can_read(reader):
                    measured[f"{figure}{suffix}"] = share_read(image, clip.words, reader)
    return {name: round(float(value), 4) for name, value in measured.items()}


def _write_panels(images: Path, folder: Path, clips: Mapping[str, Clip], methods: list[str]) -> None:
    """Write the deblurred image of every method and the truth, one file a clip."""
    images.mkdir(parents=True, exist_ok=True)
    for name, clip in clips.items():
        found = {method: folder / f"{method}-{name}.npz" for method in methods}
        shown = {method: (np.load(path)["sharp"], 0.0) for method, path in found.items() if path.exists()}
        write_image(images / f"{name}.png", panel(shown, clip), 8, overwrite=True)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", default=[], metavar="NAME", help="names or patterns; all by default")
    parser.add_argument("--methods", nargs="+", default=["*"], metavar="NAME", help="names or patterns; all by default")
    parser.add_argument("--without-videos", action="store_true", help="measure images only")
    parser.add_argument("--images", type=Path, metavar="DIR", help="write one panel of images a clip")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    parser.add_argument("--child", metavar="JSON", help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    if "--child" in sys.argv:
        print(json.dumps(run_child(json.loads(_options().child))))
    else:
        sys.exit(main())
