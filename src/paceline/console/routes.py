"""What the pages ask for and send: pictures, set-ups, imports, runs and their files."""

from __future__ import annotations

import base64
import binascii
import json
from functools import lru_cache
from typing import Any

import numpy as np
from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import FileResponse, JSONResponse, Response
from starlette.concurrency import run_in_threadpool

from paceline.cameras import StereoRig
from paceline.console.confinement import NotHere, file_below
from paceline.console.editing.clip_document import (
    Changed,
    Entry,
    Setup,
    read_lanes,
    read_setup,
    read_site_paths,
    save_setup,
)
from paceline.console.editing.edge_snapping import snapped
from paceline.console.editing.geometry_checks import check_setup, epipolar_line, propose
from paceline.console.frames.frame_cache import VIEWS
from paceline.console.frames.uploads import LARGEST_RIG, Imports, add_rig
from paceline.console.library import Library
from paceline.console.request_body import received, received_json
from paceline.console.runs.kinds import KINDS, LANES
from paceline.console.runs.options import options_of, to_number, to_whole
from paceline.console.runs.results import FILES, picture_of
from paceline.console.runs.run_list import Run
from paceline.console.target_routes import target_router
from paceline.errors import UnusableInput

MOST_POINTS = 1000
# A report is a page of its own, and made from names in files: it may show pictures and run nothing.
REPORT_POLICY = (
    "sandbox allow-same-origin allow-downloads allow-popups; default-src 'none'; img-src 'self' data:; "
    "media-src 'self'; style-src 'unsafe-inline'; frame-ancestors 'none'"
)


def add_api(app: FastAPI, library: Library, imports: Imports) -> None:
    """Adds every address below /api and /results to ``app``."""
    app.include_router(_pictures(library))
    app.include_router(_set_up(library))
    app.include_router(target_router(library))
    app.include_router(_imports(library, imports))
    app.include_router(_runs(library))

    @app.exception_handler(UnusableInput)
    async def unusable(request: Request, error: UnusableInput) -> JSONResponse:
        return JSONResponse({"reason": library.shown(error)}, 422)

    @app.exception_handler(NotHere)
    async def not_here(request: Request, error: NotHere) -> JSONResponse:
        return JSONResponse({"reason": "there is no such clip, run or file"}, 404)

    @app.exception_handler(Changed)
    async def changed(request: Request, error: Changed) -> JSONResponse:
        return JSONResponse({"reason": "the file was changed elsewhere in the meantime"}, 409)


def _pictures(library: Library) -> APIRouter:
    router = APIRouter()

    @router.get("/api/frame")
    def frame(clip: str, view: int, frame: int) -> Response:
        return _jpeg(library.gallery.jpeg(library.file(clip), _view(view), frame))

    @router.get("/api/thumbnail")
    def thumbnail(clip: str) -> Response:
        return _jpeg(library.gallery.thumbnail(library.file(clip)))

    @router.get("/api/epipolar")
    def epipolar(clip: str, view: int, x: float, y: float) -> dict[str, Any]:
        rig = library.gallery.stereo(library.file(clip)).clip.rig
        return epipolar_line(rig, _view(view), np.array([to_number(x), to_number(y)]))

    @router.get("/api/snap")
    def snap(clip: str, view: int, frame: int, x: float, y: float, reach: float) -> list[float]:
        picture = library.gallery.open(library.file(clip)).picture(_view(view), frame)
        place = snapped(picture, np.array([to_number(x), to_number(y)]), max(to_number(reach), 1.0))
        return [round(float(value), 2) for value in place]

    return router


def _set_up(library: Library) -> APIRouter:
    router = APIRouter()

    @router.get("/api/setup")
    def get(clip: str) -> dict[str, Any]:
        file = library.file(clip)
        pictures = library.gallery.stereo(file)
        setup = read_setup(file)
        rig = pictures.clip.rig
        return {
            "sizes": [camera.image_size for camera in rig.cameras],
            "frames": pictures.frames,
            "times": [round(float(t), 4) for t in pictures.times],
            "notices": pictures.recording.notices,
            "sitePaths": read_site_paths(file),
            "paths": setup.paths,
            "vehicles": setup.vehicles,
            "revision": setup.revision,
        }

    @router.put("/api/setup")
    async def put(clip: str, request: Request) -> dict[str, Any]:
        library.refuse_read_only()
        body = await received_json(request)
        setup, file = Setup(*_drawn(body), str(body.get("revision"))), library.file(clip)
        await run_in_threadpool(library.gallery.stereo, file)  # refuses what leads out of the folder
        saved = await run_in_threadpool(save_setup, file, setup)
        return {"paths": saved.paths, "vehicles": saved.vehicles, "revision": saved.revision}

    @router.post("/api/check")
    async def check(clip: str, request: Request) -> dict[str, Any]:
        paths, vehicles = _drawn(await received_json(request))
        pictures = await run_in_threadpool(library.gallery.stereo, library.file(clip))
        found = await run_in_threadpool(_check, pictures.clip.rig, json.dumps([paths, vehicles]))
        seen = [
            facts if vehicle.get("frame") in (None, *pictures.frames)
            else {"problem": f"frame {str(vehicle['frame'])[:40]} is not in the recording; outline it in one that is"}
            for vehicle, facts in zip(vehicles, found["vehicles"], strict=True)
        ]  # fmt: skip
        return {**found, "vehicles": seen}

    @router.post("/api/propose")
    async def propose_other(clip: str, request: Request) -> dict[str, Any]:
        body = await received_json(request)
        return await run_in_threadpool(_propose, library, clip, body)

    return router


@lru_cache(maxsize=64)
def _check(rig: StereoRig, drawn: str) -> dict[str, Any]:
    paths, vehicles = json.loads(drawn)
    return check_setup(rig, paths, vehicles)


def _propose(library: Library, clip: str, body: dict[str, Any]) -> dict[str, Any]:
    pictures = library.gallery.stereo(library.file(clip))
    view, frame = _view(body.get("view")), to_whole(body.get("frame"), 10**9)
    entry, path = _entry(body.get("entry")), body.get("path")
    drawn = len(entry.get(VIEWS[view], []))
    if drawn < 2 if "shape" in entry else drawn != 4:
        raise UnusableInput("entry: expected a path with its shape and two points, or a vehicle with four corners")
    shown = pictures.picture(0, frame), pictures.picture(1, frame)
    pixels, alike = propose(pictures.clip.rig, view, shown, entry, None if path is None else _path(path))
    return {"pixels": np.round(pixels, 2).tolist(), "alike": round(alike, 3)}


def _imports(library: Library, imports: Imports) -> APIRouter:
    router = APIRouter()

    @router.post("/api/import")
    async def begin(request: Request) -> dict[str, str]:
        library.refuse_read_only()
        body = await received_json(request)
        return {"key": imports.begin(str(body.get("name", "")), body.get("kind") == "chase")}

    @router.put("/api/import/{key}/{slot}")
    async def receive(key: str, slot: str, name: str, request: Request) -> dict[str, str]:
        announced = request.headers.get("content-length", "")
        size = int(announced) if announced.isdecimal() else None
        await imports.receive(key, slot, name, size, request.stream())
        return {}

    @router.post("/api/import/{key}")
    async def finish(key: str, request: Request) -> dict[str, str]:
        rate = (await received_json(request)).get("rate")
        given = None if rate is None else to_number(rate)
        return {"name": await run_in_threadpool(imports.finish, key, given)}

    @router.delete("/api/import/{key}")
    def give_up(key: str) -> dict[str, str]:
        imports.give_up(key)
        return {}

    @router.put("/api/rig")
    async def rig(clip: str, request: Request) -> dict[str, str]:
        library.refuse_read_only()
        content = await received(request.stream(), LARGEST_RIG)
        await run_in_threadpool(add_rig, library.file(clip), content)
        return {}

    return router


def _runs(library: Library) -> APIRouter:
    router = APIRouter()

    @router.post("/api/run")
    async def start(clip: str, request: Request) -> dict[str, Any]:
        library.refuse_read_only()
        body = await received_json(request)
        kind, options = body.get("kind"), body.get("options", {})
        if kind not in KINDS or not isinstance(options, dict):
            raise UnusableInput(f"kind: expected one of {', '.join(KINDS)}")
        return _shown(await run_in_threadpool(library.runs.start, clip, kind, options_of(kind, options)))

    @router.get("/api/run")
    def get(clip: str, number: int) -> dict[str, Any]:
        return _shown(_found(library, clip, number))

    @router.delete("/api/run")
    def cancel(clip: str, number: int) -> dict[str, str]:
        library.runs.cancel(clip, _found(library, clip, number).number)
        return {}

    @router.get("/api/proposed")
    def proposed(clip: str, number: int) -> dict[str, Any]:
        run = _found(library, clip, number)
        if run.kind == LANES:
            return {"paths": read_lanes(file_below(library.runs.folder(run), "site.yaml")), "vehicles": []}
        return {"paths": {}, "vehicles": read_setup(library.runs.asked(run)).vehicles}

    @router.get("/api/live")
    def live(clip: str, number: int, frame: int, view: int) -> Response:
        return _jpeg(library.runs.picture(_found(library, clip, number), frame, view))

    @router.get("/results/{clip}/{number}/pictures/{vehicle}.jpg")
    def picture(clip: str, number: int, vehicle: str) -> FileResponse:
        run = _found(library, clip_of(clip), number)
        return FileResponse(file_below(library.runs.out(run), picture_of(vehicle)))

    @router.get("/results/{clip}/{number}/{name}")
    def result(clip: str, number: int, name: str, save: bool = False) -> FileResponse:
        run = _found(library, clip_of(clip), number)
        if name not in FILES:
            raise NotHere(name)
        file = file_below(library.runs.out(run), name)
        answer = FileResponse(file, filename=name if save else None)
        if file.suffix == ".html":
            answer.headers["Content-Security-Policy"] = REPORT_POLICY
        return answer

    return router


def results_address(clip: str, number: int, name: str) -> str:
    """Where a file of a run is; a clip's name may hold what addresses do not keep as it is."""
    return f"/results/{base64.urlsafe_b64encode(clip.encode()).decode().rstrip('=')}/{number}/{name}"


def clip_of(address: str) -> str:
    """The clip that `results_address` named. Raises NotHere."""
    try:
        return base64.urlsafe_b64decode(address + "=" * (-len(address) % 4)).decode()
    except (binascii.Error, ValueError) as error:
        raise NotHere(address) from error


def _found(library: Library, clip: str, number: int) -> Run:
    run = library.runs.get(clip, number)
    if run is None:
        raise NotHere(f"{clip} {number}")
    return run


def _shown(run: Run) -> dict[str, Any]:
    return {"number": run.number, "state": run.state, "reason": run.reason, "done": run.done, "total": run.total}


def _drawn(body: dict[str, Any]) -> tuple[dict[str, Entry], list[Entry]]:
    paths, vehicles = body.get("paths"), body.get("vehicles")
    if not isinstance(paths, dict) or not isinstance(vehicles, list):
        raise UnusableInput("expected paths by name and a list of vehicles")
    return {str(name): _path(path) for name, path in paths.items()}, [_entry(v) for v in vehicles]


def _path(value: object) -> Entry:
    path = _entry(value)
    if "shape" not in path:
        raise UnusableInput("a path: expected shape line or curve")
    return path


def _entry(value: object) -> Entry:
    if not isinstance(value, dict):
        raise UnusableInput("expected a path or a vehicle with its keys")
    for key, length in (("left", 2), ("right", 2), ("points", 3)):
        points = value.get(key, [])
        if not isinstance(points, list) or len(points) > MOST_POINTS:
            raise UnusableInput(f"{key}: expected a list of at most {MOST_POINTS} points")
        for point in points:
            if not isinstance(point, list) or len(point) != length:
                raise UnusableInput(f"{key}: expected points of {length} numbers")
            for number in point:
                to_number(number)
    if value.get("shape", "line") not in ("line", "curve") or not isinstance(value.get("path", ""), str):
        raise UnusableInput("expected shape line or curve, and the name of a path")
    return value


def _view(value: object) -> int:
    if value not in (0, 1):
        raise UnusableInput("view: expected 0 for left or 1 for right")
    return int(value)


def _jpeg(content: bytes) -> Response:
    return Response(content, media_type="image/jpeg", headers={"Cache-Control": "private, no-cache"})
