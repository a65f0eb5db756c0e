"""Runs the console as a web server for one folder, until the process is interrupted."""

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

from paceline.console.access_control import AccessControl
from paceline.console.frames.uploads import Uploads
from paceline.console.library import Library
from paceline.console.routes import add_routes
from paceline.errors import UnusableInput

DEFAULT_PORT = 8640
MAX_TRIED_PORTS = 10  # ports that are tried from DEFAULT_PORT on, if no port is given
RECONNECT_TIMEOUT_S = 30.0  # time limit for a page to reconnect: runs may use the whole computer


def serve(folder: Path, host: str, port: int | None, browse: bool, report: Callable[[str], None]) -> None:
    """Serves the clips below ``folder`` until the process is interrupted; messages for the user go to ``report``.

    Raises UnusableInput where the folder or the address cannot be used.
    """
    try:
        root = folder.resolve()
        exists = root.is_dir()
    except (OSError, RuntimeError) as error:  # no permission, a name too long, a cycle of links
        raise UnusableInput(f"{str(folder)[:200]}: cannot be read") from error
    if not exists:
        raise UnusableInput(f"{folder}: is no folder; expected the one that holds the clips")
    if not os.access(root, os.R_OK | os.X_OK):
        raise UnusableInput(f"{folder}: cannot be read; expected a folder of clips")
    listening = _open_socket(host, port)
    with contextlib.closing(listening):
        address, token = _public_address(host, listening.getsockname()[1])
        library = Library(root)
        imports = Uploads(root)
        try:
            app = make_app(library, imports)
            protected = AccessControl(app, _host_names(address), token)
            settings = uvicorn.Config(
                protected, log_level="warning", server_header=False, ws="websockets-sansio", timeout_graceful_shutdown=2
            )
            report(f"The console of {root} is at {address}\nCtrl-C ends it.")
            if library.read_only:
                report("The folder cannot be written: clips and results can be viewed, not changed or measured.")
            if browse:
                webbrowser.open(address)
            with contextlib.suppress(KeyboardInterrupt):  # the usual way to stop it
                uvicorn.Server(settings).run(sockets=[listening])
        finally:
            library.runs.close()
            imports.close()


def make_app(library: Library, imports: Uploads) -> FastAPI:
    """The whole application, without access control."""
    # NiceGUI reads this when it is imported; the console stores nothing there, so the folder is never created.
    os.environ.setdefault("NICEGUI_STORAGE_PATH", str(library.root / ".paceline-console"))
    from nicegui import ui

    from paceline.console.pages import add_pages

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield

    app = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    add_routes(app, library, imports)
    with resources.as_file(resources.files("paceline.console") / "static") as static:
        app.mount("/static", StaticFiles(directory=static))
    add_pages(library)
    ui.run_with(app, title="Paceline", dark=None, show_welcome_message=False, reconnect_timeout=RECONNECT_TIMEOUT_S)
    return app


def _open_socket(host: str, port: int | None) -> socket.socket:
    ports = [port] if port is not None else list(range(DEFAULT_PORT, DEFAULT_PORT + MAX_TRIED_PORTS))
    for number in ports:
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            listening = socket.socket(family, kind)
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listening.bind(address)
                listening.listen(64)
            except OSError:
                listening.close()
                raise
            return listening
        except OSError as error:
            if number == ports[-1]:
                raise UnusableInput(f"--host {host} --port {number}: cannot be used ({error.strerror})") from error
    raise AssertionError("at least one port is tried")


def _host_names(address: str) -> set[str]:
    """The Host headers that mean ``address``."""
    name = address.split("/")[2].removesuffix(":80")
    return {name, name.replace("127.0.0.1", "localhost"), name.replace("localhost", "127.0.0.1")}


def _public_address(host: str, port: int) -> tuple[str, str | None]:
    """The console's URL, with a token where other machines can reach it, and the token."""
    try:
        number = ipaddress.ip_address(host)
    except ValueError:
        number = None
    host_text = f"[{host}]" if number is not None and number.version == 6 else host
    if host == "localhost" or (number is not None and number.is_loopback):
        return f"http://{host_text}:{port}/", None
    if number is not None and number.is_unspecified:
        host_text = socket.gethostname()
    token = secrets.token_urlsafe(24)
    return f"http://{host_text}:{port}/?token={token}", token
