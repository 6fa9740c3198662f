"""``turbrestore sample``: a clip to try."""

from __future__ import annotations

from pathlib import Path

from turbrestore.core.errors import OutputError
from turbrestore.io.images.image_files import write_image
from turbrestore.io.output import check_output
from turbrestore.io.video import write_video
from turbrestore.synthesis.sample import RATE, sample_clip

from .options import Flag
from .progress import say


def sample(folder: Path, /, *, overwrite: Flag = False, quiet: Flag = False) -> None:
    """Write the sample clip, chart.mkv, and its truth, chart_truth.png.

    Parameters
    ----------
    folder : Path
        Folder to write to; it is made if it is not there.
    overwrite : bool
        Replace existing files.
    quiet : bool
        Print no remarks.
    """
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); name another folder") from error
    video, image = folder / "chart.mkv", folder / "chart_truth.png"
    for path in (video, image):
        check_output(path, overwrite=overwrite, suffixes=None)
    frames, truth = sample_clip()
    write_video(video, frames, RATE, bit_depth=8, overwrite=overwrite)
    write_image(image, truth, 8, overwrite=overwrite)
    say(f"{video}: {len(frames)} frames to try, for example: turbrestore restore {video} sharp.png", quiet)
