"""``turbrestore app``: the page in the browser."""

from __future__ import annotations

from pathlib import Path

from turbrestore.core.errors import DataError, require

from .options import Flag
from .streams import put


def app(
    file: Path | None = None,
    /,
    *,
    allow: tuple[Path, ...] = (),
    port: int = 0,
    no_browser: Flag = False,
) -> None:
    """Choose, restore and tune a clip in the browser, on this machine alone.

    The page is served on 127.0.0.1, at an address with a random part, until Ctrl-C.  It reads and writes below the
    folder in which it is started.

    Parameters
    ----------
    file : Path
        Clip to open.
    allow : tuple of Path
        One more folder in which files may be read and written; may be repeated.
    port : int
        Port of the server; 0 takes one that is free.
    no_browser : bool
        Print the address alone, and open no browser.
    """
    from turbrestore.io.limits import check_input

    require(0 <= port <= 65535, f"--port: expected a number from 0 to 65535, found {port}")
    for folder in allow:
        check_input(folder)
        if not folder.is_dir():
            raise DataError(f"{folder}: expected a folder, found a file")
    if file is not None:
        check_input(file)
    from turbrestore_app.folders import Folders
    from turbrestore_app.server import serve

    files = () if file is None else (file.absolute(),)
    folders = Folders(Path.cwd(), tuple(folder.absolute() for folder in allow), files)
    serve(folders, file, port, not no_browser, lambda address: put(f"{address}\nCtrl-C ends it."))
