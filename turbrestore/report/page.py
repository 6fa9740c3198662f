"""The page: a template filled with pictures, plots and facts.

The page is self-contained. Its content security policy allows only images in data URIs and its own style sheet and
script, which it names by their hashes. File names and remarks are escaped, so they are never markup.
"""

from __future__ import annotations

import base64
import hashlib
import os
import shlex
from collections.abc import Iterable
from importlib.util import find_spec

from ..core.extras import missing_package
from ..io.output import atomic_write, check_output
from ..results import Restoration
from ..runs.run_record import RunRecord
from .comparison import comparison, environment, text_file
from .facts import findings, headline, laps, settings
from .panels import draw_panels
from .pictures import encode_gallery, stages

_SUFFIXES = (".html", ".htm")
_PACKAGES = ("matplotlib", "jinja2")


def check_report(
    path: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str]] = (), overwrite: bool = False
) -> None:
    """Raise an error before the work begins if the report could not be written."""
    check_output(path, inputs, overwrite, _SUFFIXES)
    # The packages are only looked for here; loading them takes memory that the restoration needs.
    for package in _PACKAGES:
        if find_spec(package) is None:
            raise missing_package("report", package, "report")


def write_report(
    path: str | os.PathLike[str], restoration: Restoration, run: RunRecord, overwrite: bool = False
) -> None:
    """Write a restoration as one HTML file.

    Parameters
    ----------
    path : path
        Ends in .html or .htm.
    restoration : Restoration
        Complete, or stopped after an earlier stage.
    run : RunRecord
        Input, settings and versions, see :func:`turbrestore.runs.run_record.describe_run`.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    ConfigurationError
        The suffix is not .html or .htm, or a package is not installed.
    OutputError
        The file exists, or its folder does not.
    StorageError
        Writing failed; nothing is left behind.

    Examples
    --------
    >>> import numpy as np, pathlib, tempfile
    >>> from turbrestore.pipeline import RestoreParams, restore
    >>> frames = np.random.default_rng(0).uniform(size=(4, 32, 32)).astype(np.float32)
    >>> restoration = restore(frames, RestoreParams(until="centroid"))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_report(folder + "/report.html", restoration, RunRecord("noise", frames[2]))
    ...     pathlib.Path(folder, "report.html").read_text("utf-8")[:15]
    '<!doctype html>'
    """
    check_report(path, overwrite=overwrite)
    # On most systems file names are bytes, which need not be valid text.
    atomic_write(path, render_report(restoration, run).encode(errors="replace"), overwrite)


def render_report(restoration: Restoration, run: RunRecord) -> str:
    """Return the report of a restoration as HTML."""
    template = environment().get_template("template.html")
    gallery = encode_gallery(stages(restoration, run.frame), run.frame_number)
    panels = draw_panels(restoration, run)
    return template.render(
        page_code(("palette.css", "compare.css", "style.css"), ("compare.js",)),
        run=run,
        restoration=restoration,
        comparison=comparison(gallery),
        plots=[
            [
                [panel for panel in panels if (panel.is_special, panel.is_map) == (special, wanted)]
                for wanted in (True, False)
            ]
            for special in (False, True)
        ],
        headline=headline(restoration),
        findings=findings(restoration),
        verdict=restoration.verdict,
        settings=settings(run),
        laps=laps(restoration),
        command=shlex.join(run.command),
    )


def page_code(styles: Iterable[str], scripts: Iterable[str] = (), media: str = "'none'") -> dict[str, str]:
    """Return style sheet and script of a page, and the content security policy that allows only what it contains."""
    from markupsafe import Markup

    style, script = ("".join(map(text_file, names)) for names in (styles, scripts))
    style_hash, script_hash = (
        base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (style, script)
    )
    policy = (
        f"default-src 'none'; img-src data:; media-src {media}; style-src 'sha256-{style_hash}'; "
        f"script-src 'sha256-{script_hash}'; base-uri 'none'; form-action 'none'"
    )
    return {"style": Markup(style), "script": Markup(script), "policy": policy}
