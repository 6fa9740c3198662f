"""Make the pictures of the README and of the documentation, all from clips that turbrestore synthesizes itself.

Run ``python docs/make_figures.py``; names of groups (``film``, ``gallery``, ``stages``, ``videos``, ``recipes``) make
only these.

The photographs come with scikit-image and are in the public domain or under CC0: the photographer by Lav Varshney, the
cat by Stefan van der Walt, the gravel from CC0Textures.  What else is shown is drawn by
``turbrestore.synthesis.drawn_scenes`` and ``turbrestore.synthesis.scenes``.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tempfile
import time
from contextlib import chdir
from functools import cache
from pathlib import Path

import numpy as np
from _figures import scenes, stages
from _figures.clips import Clip, clip, film
from _figures.layout import row, save, save_film

import turbrestore as tr
from turbrestore.core.arrays import FloatArray
from turbrestore.synthesis.atmosphere import STRENGTHS
from turbrestore.synthesis.drawn_scenes import planet, road_sign, street
from turbrestore.synthesis.scenes import picture, printed_words, resolution_chart

SIDE = 224
FILM_SIDE, FILM_HEIGHT = 256, 384
VIDEO_FRAMES = 60
LARGEST_RECIPE, LARGEST_ROW = 120_000, 180_000
# Name, scene, strength of the air, number of frames, and noise of the camera.
GALLERY = {
    "chart": (lambda: resolution_chart(SIDE, SIDE), "weak", 48, 0.005),
    "words": (lambda: printed_words(SIDE, SIDE), "strong", 60, 0.005),
    "sign": (lambda: road_sign(SIDE, SIDE), "medium", 48, 0.005),
    "label": (lambda: scenes.label(SIDE, SIDE), "strong", 60, 0.005),
    "photographer": (lambda: picture("camera", SIDE, SIDE), "medium", 60, 0.005),
    "cat": (lambda: picture("cat", SIDE, SIDE), "medium", 60, 0.005),
    "planet": (lambda: planet(SIDE, SIDE), "medium", 120, 0.03),
    "street": (lambda: street(SIDE, SIDE), "weak", 60, 0.005),
    "gravel": (lambda: picture("gravel", SIDE, SIDE), "strong", 48, 0.005),
}


@cache
def gallery_clip(name: str) -> Clip:
    """Clip of the gallery, made once."""
    scene, strength, count, noise = GALLERY[name]
    objects = scenes.traffic(SIDE, SIDE) if name == "street" else ()
    return clip(scene(), strength, count, noise, objects)


@cache
def steadied_street() -> FloatArray:
    """Frames of the street, steadied."""
    return steadied_beside(gallery_clip("street").frames)[1]


def make_film() -> None:
    """Frames of a clip one after the other, beside the image that is restored from them."""
    frames = film(street(FILM_SIDE, FILM_SIDE), STRENGTHS["medium"], 60)
    image = tr.restore(frames).image
    # Forwards and backwards, so that it has no jump.
    order = [*range(36), *range(34, 0, -1)]
    label = f"restored from {len(frames)} frames"
    pictures = [row({"video through haze": frames[k], label: image}, FILM_HEIGHT) for k in order]
    save_film("haze", pictures, milliseconds=80, quality=80)


def make_gallery() -> None:
    """Frame, temporal mean, result and truth of every scene, and the table of their PSNR in gallery.md."""
    rows = []
    for name, (_, strength, count, noise) in GALLERY.items():
        shown = gallery_clip(name)
        panels = {
            "frame": shown.frame,
            "temporal mean": shown.restoration.mean,
            "restored": shown.restoration.image,
            "truth": shown.truth,
        }
        figures = [tr.compare(image, shown.truth).psnr for image in list(panels.values())[:3]]
        air = f"{strength}, noisy" if noise > 0.01 else strength
        rows.append(f"| {name} | {air} | {count} | {' | '.join(f'{value:.1f}' for value in figures)} |\n")
        print(rows[-1], end="", flush=True)
        save(f"gallery_{name}", row(panels), LARGEST_ROW)
    page = Path(__file__).with_name("gallery.md")
    table = re.compile(r"(?<=\|---\|---\|---:\|---:\|---:\|---:\|\n)(?:\|.*\n)+")
    page.write_text(table.sub("".join(rows), page.read_text("utf-8")), "utf-8")


def make_stages() -> None:
    """One picture for each stage."""
    stages.style()
    shown = gallery_clip("photographer")
    for make in (
        stages.frames,
        stages.flow,
        stages.centroid,
        stages.dynamics,
        stages.filtering,
        stages.blur,
        stages.deconvolution,
    ):
        make(shown)
    strengths = {STRENGTHS[name]: film(shown.truth, STRENGTHS[name], 40) for name in STRENGTHS}
    stages.seeing(strengths, shown)
    stages.steady(gallery_clip("street").frames, steadied_street())


def make_videos() -> None:
    """Frames of videos one after the other, beside the steadied ones."""
    wide = film(picture("camera", SIDE, SIDE + VIDEO_FRAMES), STRENGTHS["medium"], VIDEO_FRAMES)
    videos = {
        "traffic": (gallery_clip("street").frames, steadied_street()),
        "pan": steadied_beside(np.stack([frame[:, k : k + SIDE] for k, frame in enumerate(wide)])),
        "words": steadied_beside(gallery_clip("words").frames),
    }
    for name, (before, after) in videos.items():
        pictures = [row({"video through haze": a, "steadied": b}) for a, b in zip(before, after, strict=True)]
        save_film(f"video_{name}", pictures, milliseconds=80, quality=60)


def steadied_beside(frames: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frames, and the same steadied."""
    return frames, np.stack([frame.image for frame in tr.steady_frames(frames)])


def make_recipes() -> None:
    """Pictures of the recipes, from the files that the commands of each page write."""
    for page, shown in RECIPES.items():
        with tempfile.TemporaryDirectory() as folder, chdir(folder):
            for command in commands_before(page, [name for name, _ in shown.values()]):
                print(command, flush=True)
                subprocess.run(shlex.split(command), check=True)
            panels = {title: picture_of(Path(name), frame) for title, (name, frame) in shown.items()}
        save(f"recipe_{page}", row(panels, 288), LARGEST_RECIPE)


def commands_before(page: str, files: list[str]) -> list[str]:
    """Commands of a recipe up to the last that writes one of the files."""
    text = (Path(__file__).parent / "recipes" / f"{page}.md").read_text("utf-8").replace("\\\n", " ")
    commands = re.findall(r"(?m)^ *(turbrestore .*)$", text)
    last = max(index for index, command in enumerate(commands) if set(files) & set(shlex.split(command)[3:4]))
    # The Moon of the page for planets, and files of the reader's own, are not shown.
    return [command for command in commands[: last + 1] if not re.search(r"crater|night|moon|sweep|evaluate", command)]


def picture_of(path: Path, frame: int | None) -> FloatArray:
    """Read an image, or a frame of a video."""
    return tr.read_image(path).image if frame is None else tr.open_frames(path).read(frame, frame + 1)[0]


# Page, and for each panel the file that shows it and the frame of a video.
RECIPES: dict[str, dict[str, tuple[str, int | None]]] = {
    "road": {
        "frame": ("road.mp4", 40),
        "steadied frame": ("steady.mp4", 40),
        "still image": ("street.png", None),
    },
    "text": {
        "frame": ("plate.mkv", 50),
        "temporal mean": ("plate_stages/mean.png", None),
        "restored": ("plate.png", None),
    },
    "planet": {
        "frame": ("planet.ser", 60),
        "restored": ("planet.png", None),
        "restored, --sigma 1.6": ("planet_sharp.png", None),
    },
    "simulate": {
        "scene": ("clip.truth.png", None),
        "frame": ("clip.mkv", 30),
        "another scene moves alike": ("more.mkv", 30),
        "moving objects": ("moving.mkv", 30),
    },
}
GROUPS = {
    "film": make_film,
    "gallery": make_gallery,
    "stages": make_stages,
    "videos": make_videos,
    "recipes": make_recipes,
}


def main() -> None:
    """Make the groups that the command line names, or all."""
    begun = time.monotonic()
    for name in sys.argv[1:] or GROUPS:
        GROUPS[name]()
    print(f"{time.monotonic() - begun:.0f} s")


if __name__ == "__main__":
    main()
