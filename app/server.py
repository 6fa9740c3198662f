"""The server of the page: on this machine alone, at an address that nobody can guess."""

from __future__ import annotations

import asyncio
import math
import os
import secrets
import socket
import tempfile
import threading
import webbrowser
from collections.abc import Callable
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from turbrestore.core.errors import StorageError
from turbrestore.core.extras import missing_package
from turbrestore.io.limits import DEFAULT_LIMITS

from .folders import Folders
from .guard import Guard
from .tab import Tab

if TYPE_CHECKING:
    import uvicorn
    from fastapi import Response
    from nicegui import Client

HOST = "127.0.0.1"
# Seconds that open connections have at the end.
_FAREWELL = 1
# Seconds after which a tab that has left is forgotten, and after which one that does not answer is called again: the
# server answers late while all cores work.
_ABSENCE, _SILENCE = 3.0, 20.0
# Seconds between two looks at pages that are on their way.
_BEAT = 0.1


def serve(
    folders: Folders, file: Path | None, port: int, browser: bool, announce: Callable[[str], None] = print
) -> None:
    """Serve the page until the program is interrupted.

    Parameters
    ----------
    folders : Folders
        What the page may read and write.
    file : Path or None
        Clip to open at first.
    port : int
        0 takes one that is free.
    browser : bool
        Whether the page is opened in the browser of the system.
    announce : callable
        Called with the address once the server can be reached.

    Raises
    ------
    ConfigurationError
        NiceGUI is not installed.
    StorageError
        The port is taken.
    """
    with tempfile.TemporaryDirectory(prefix="turbrestore-") as storage:
        # The library would keep a file in the folder of the start.
        os.environ["NICEGUI_STORAGE_PATH"] = storage
        if find_spec("nicegui") is None:
            raise missing_package("app", "nicegui", "app")
        with closing(_listen(port)) as listener:
            _serve(listener, folders, file, browser, announce)


def _serve(
    listener: socket.socket, folders: Folders, file: Path | None, browser: bool, announce: Callable[[str], None]
) -> None:
    from nicegui import binding

    # NiceGUI warns that bindings are slow while all cores work; a user can do nothing about that.
    binding.MAX_PROPAGATION_TIME = math.inf
    token, port = secrets.token_urlsafe(18), listener.getsockname()[1]
    address = f"http://{HOST}:{port}/{token}/"
    tabs: set[Tab] = set()
    server = _build(token, port, folders, file, tabs)
    announce(address)
    if browser:
        threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
    try:
        server.run(sockets=[listener])
    finally:
        for tab in tuple(tabs):
            tab.close()


def _build(token: str, port: int, folders: Folders, file: Path | None, tabs: set[Tab]) -> uvicorn.Server:
    """Put the page, its images and the guard together."""
    import uvicorn
    from fastapi import FastAPI, Response
    from fastapi.responses import FileResponse
    from nicegui import app, ui

    # Tab and page of every tab of the browser, which keeps its name when the page is loaded again.
    shown: dict[str, tuple[Tab, Client]] = {}

    @ui.page("/", title="turbrestore", reconnect_timeout=_ABSENCE)
    async def page() -> None:
        await _show(shown, tabs, folders, file)

    @app.get("/pictures/{key}/{name}", response_class=Response)
    def picture(key: str, name: str) -> Response:
        tab = _find(tabs, key)
        data = None if tab is None else tab.pictures.get(name)
        if data is None:
            return _nothing_for(tab)
        return Response(data, media_type="image/png", headers={"Cache-Control": "no-store"})

    @app.get("/videos/{key}/{name}", response_class=Response)
    def video(key: str, name: str) -> Response:
        tab = _find(tabs, key)
        film = None if tab is None else tab.films.get(name)
        # The system may have emptied its folder of temporary files.
        if film is None or not film.is_file():
            return _nothing_for(tab)
        return FileResponse(film, media_type="video/mp4", headers={"Cache-Control": "no-store"})

    def stop_all() -> None:
        for tab in tabs:
            tab.closed = True
            tab.stop()

    app.on_shutdown(stop_all)
    web = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    ui.run_with(
        web,
        mount_path=f"/{token}",
        title="turbrestore",
        dark=None,
        tailwind=False,
        show_welcome_message=False,
        reconnect_timeout=_SILENCE,
    )
    # Beside the file, a form has its own words.
    guard = Guard(web, token, port, DEFAULT_LIMITS.max_bytes + 4096)
    config = uvicorn.Config(guard, log_level="critical", access_log=False, timeout_graceful_shutdown=_FAREWELL)
    return uvicorn.Server(config)


def _nothing_for(tab: Tab | None) -> Response:
    """Answer a request for what does not exist, which is an error for strangers only.

    A busy browser may ask late for what newer images have replaced; that is no error, so its answer is an empty one.
    """
    from fastapi import Response

    return Response(status_code=404 if tab is None else 204)


def _find(tabs: set[Tab], key: str) -> Tab | None:
    return next((tab for tab in tuple(tabs) if secrets.compare_digest(tab.key, key)), None)


async def _show(shown: dict[str, tuple[Tab, Client]], tabs: set[Tab], folders: Folders, file: Path | None) -> None:
    """Show a tab of the browser what it had before it was loaded again, or a new page."""
    from nicegui import app, ui

    from .views.page import Page, add_styles_and_scripts

    add_styles_and_scripts()
    client = ui.context.client
    await client.connected()
    name = client.tab_id
    # The browser may have left before it had the page.
    if name is None:
        return
    tab, earlier = shown.get(name, (None, None))
    if earlier is not None:
        # The page before goes no further; its images would take the places of those of this one.
        earlier.remove_all_elements()
    tab = tab or Tab(folders)
    shown[name] = tab, client
    tabs.add(tab)

    async def leave() -> None:
        # Any page that is still on its way to a busy browser may be this tab, loaded again.
        expected = True
        while expected:
            expected = any(not each.has_socket_connection for each in app.clients("/"))
            # A page that has just been connected has not told its tab yet.
            await asyncio.sleep(_BEAT)
        if shown.get(name) == (tab, client):
            del shown[name]
            tabs.discard(tab)
            threading.Thread(target=tab.close).start()

    client.on_delete(leave)
    await Page(tab).show(file)


def _listen(port: int) -> socket.socket:
    try:
        return socket.create_server((HOST, port))
    except (OSError, OverflowError) as error:
        raise StorageError(f"--port: {port} cannot be used ({error})") from error
