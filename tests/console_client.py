"""A client of the console's HTTP routes without a browser: a folder with one clip, beside one it may not see."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.testclient import TestClient
from tiny_clips import put_clip

from paceline.console.access_control import AccessControl
from paceline.console.frames.uploads import Uploads
from paceline.console.library import Library
from paceline.console.routes import add_routes

HOST = "127.0.0.1:8640"
SAME = {"host": HOST, "origin": f"http://{HOST}", "sec-fetch-site": "same-origin"}


def put_folder(base: Path) -> Path:
    """A folder with one clip, beside another folder that the console must not see."""
    put_clip(base / "mine")
    secret = put_clip(base, "secret")
    (secret / "secret.txt").write_text("secret")
    return base / "mine"


@contextmanager
def open_client(folder: Path) -> Iterator[TestClient]:
    """A test client of the console of a ``folder``; with the headers SAME its requests look like its own pages'."""
    library, imports = Library(folder), Uploads(folder)
    app = FastAPI()
    add_routes(app, library, imports)
    guarded: Any = AccessControl(app, {HOST}, None)
    with TestClient(guarded, base_url=f"http://{HOST}") as client:
        yield client
    library.runs.close()
    imports.close()
