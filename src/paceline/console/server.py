"""The console as a running server: one folder, one address, until it is told to end."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import secrets
import socket
import webbrowser
from collections.abc import AsyncIterator, Callable
from importlib import resources
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles

from paceline.console.access_control import Guard
from paceline.console.frames.uploads import Imports
from paceline.console.library import Library
from paceline.console.routes import add_api
from paceline.errors import UnusableInput

DEFAULT_PORT = 8640
TRIED = 10  # ports from the default one on, where none is asked for
PATIENCE = 30.0  # s without a sign of a page: runs may take all of the computer


def serve(folder: Path, host: str, port: int | None, browse: bool, say: Callable[[str], None]) -> None:
    """Serves the clips below ``folder`` until the process is told to end. Raises UnusableInput."""
    try:
        root = folder.resolve()
        there = root.is_dir()
    except (OSError, RuntimeError) as error:  # not ours to see, a name too long, links in a circle
        raise UnusableInput(f"{str(folder)[:200]}: cannot be read") from error
    if not there:
        raise UnusableInput(f"{folder}: is no folder; expected the one that holds the clips")
    if not os.access(root, os.R_OK | os.X_OK):
        raise UnusableInput(f"{folder}: cannot be read; expected a folder of clips")
    listening = _listen(host, port)
    with contextlib.closing(listening):
        address, token = _address(host, listening.getsockname()[1])
        library = Library(root)
        imports = Imports(root)
        try:
            app = make_app(library, imports)
            guarded = Guard(app, _names(address), token)
            settings = uvicorn.Config(
                guarded, log_level="warning", server_header=False, ws="websockets-sansio", timeout_graceful_shutdown=2
            )
            say(f"The console of {root} is at {address}\nCtrl-C ends it.")
            if library.read_only:
                say("The folder cannot be written: its clips can be looked at and read, not changed or measured.")
            if browse:
                webbrowser.open(address)
            with contextlib.suppress(KeyboardInterrupt):  # the usual way to end it
                uvicorn.Server(settings).run(sockets=[listening])
        finally:
            library.runs.close()
            imports.close()


def make_app(library: Library, imports: Imports) -> FastAPI:
    """The whole application, not yet guarded."""
    # Decided when it is imported; the console keeps nothing there, and so leaves no folder of that name behind.
    os.environ.setdefault("NICEGUI_STORAGE_PATH", str(library.root / ".paceline-console"))
    from nicegui import ui

    from paceline.console.pages import add_pages

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield

    app = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    add_api(app, library, imports)
    with resources.as_file(resources.files("paceline.console") / "static") as static:
        app.mount("/static", StaticFiles(directory=static))
    add_pages(library)
    ui.run_with(app, title="Paceline", dark=None, show_welcome_message=False, reconnect_timeout=PATIENCE)
    return app


def _listen(host: str, port: int | None) -> socket.socket:
    wanted = [port] if port is not None else list(range(DEFAULT_PORT, DEFAULT_PORT + TRIED))
    for number in wanted:
        try:
            family, kind, _, _, where = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            listening = socket.socket(family, kind)
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listening.bind(where)
                listening.listen(64)
            except OSError:
                listening.close()
                raise
            return listening
        except OSError as error:
            if number == wanted[-1]:
                raise UnusableInput(f"--host {host} --port {number}: cannot be used ({error.strerror})") from error
    raise AssertionError("some port is always tried")


def _names(address: str) -> set[str]:
    """What a request may call the host of ``address``."""
    name = address.split("/")[2].removesuffix(":80")
    return {name, name.replace("127.0.0.1", "localhost"), name.replace("localhost", "127.0.0.1")}


def _address(host: str, port: int) -> tuple[str, str | None]:
    """Where a browser finds the console, with a token for any address that other machines can reach."""
    try:
        number = ipaddress.ip_address(host)
    except ValueError:
        number = None
    shown = f"[{host}]" if number is not None and number.version == 6 else host
    if host == "localhost" or (number is not None and number.is_loopback):
        return f"http://{shown}:{port}/", None
    if number is not None and number.is_unspecified:
        shown = socket.gethostname()
    token = secrets.token_urlsafe(24)
    return f"http://{shown}:{port}/?token={token}", token
