"""The HTTP routes of the console's pages: frames, set-ups, imports, runs and their files."""

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

from paceline.cameras import VIEW_NAMES, StereoRig
from paceline.console.confinement import NotFound, file_below
from paceline.console.editing.clip_document import (
    ClipSetup,
    Entry,
    FileChanged,
    read_clip_setup,
    read_paths_of_site,
    read_site_paths,
    save_clip_setup,
)
from paceline.console.editing.edge_snapping import snap_point
from paceline.console.editing.geometry_checks import check_setup, epipolar_line, propose_in_other_view
from paceline.console.frames.uploads import MAX_YAML_BYTES, Uploads, add_rig
from paceline.console.library import Library
from paceline.console.request_body import read_body, read_json
from paceline.console.runs.kinds import LANES_RUN, RUN_KINDS
from paceline.console.runs.options import command_options, parse_number, parse_whole_number
from paceline.console.runs.results import PICTURE_FOLDERS, RESULT_FILES, picture_name
from paceline.console.runs.run_queue import Run
from paceline.console.target_routes import target_router
from paceline.errors import UnusableInput

MAX_DRAWN_POINTS = 1000
# A report holds names from files: it may show images, and may run no scripts.
REPORT_SECURITY_POLICY = (
    "sandbox allow-same-origin allow-downloads allow-popups; default-src 'none'; img-src 'self' data:; "
    "media-src 'self'; style-src 'unsafe-inline'; frame-ancestors 'none'"
)


def add_routes(app: FastAPI, library: Library, imports: Uploads) -> None:
    """Adds all routes below /api and /results to ``app``."""
    app.include_router(_picture_routes(library))
    app.include_router(_setup_routes(library))
    app.include_router(target_router(library))
    app.include_router(_import_routes(library, imports))
    app.include_router(_run_routes(library))

    @app.exception_handler(UnusableInput)
    async def unusable(request: Request, error: UnusableInput) -> JSONResponse:
        return JSONResponse({"reason": library.relative_message(error)}, 422)

    @app.exception_handler(NotFound)
    async def not_here(request: Request, error: NotFound) -> JSONResponse:
        return JSONResponse({"reason": "there is no such clip, run or file"}, 404)

    @app.exception_handler(FileChanged)
    async def changed(request: Request, error: FileChanged) -> JSONResponse:
        return JSONResponse({"reason": "the file was changed elsewhere in the meantime"}, 409)


def _picture_routes(library: Library) -> APIRouter:
    router = APIRouter()

    @router.get("/api/frame")
    def frame(clip: str, view: int, frame: int) -> Response:
        return _jpeg_response(library.frame_cache.jpeg(library.file(clip), _parse_view(view), frame))

    @router.get("/api/thumbnail")
    def thumbnail(clip: str) -> Response:
        return _jpeg_response(library.frame_cache.thumbnail(library.file(clip)))

    @router.get("/api/epipolar")
    def epipolar(clip: str, view: int, x: float, y: float) -> dict[str, Any]:
        rig = library.frame_cache.stereo(library.file(clip)).clip.rig
        return epipolar_line(rig, _parse_view(view), np.array([parse_number(x), parse_number(y)]))

    @router.get("/api/snap")
    def snap(clip: str, view: int, frame: int, x: float, y: float, reach: float) -> list[float]:
        picture = library.frame_cache.open(library.file(clip)).picture(_parse_view(view), frame)
        place = snap_point(picture, np.array([parse_number(x), parse_number(y)]), max(parse_number(reach), 1.0))
        return [round(float(value), 2) for value in place]

    return router


def _setup_routes(library: Library) -> APIRouter:
    router = APIRouter()

    @router.get("/api/setup")
    def get(clip: str) -> dict[str, Any]:
        file = library.file(clip)
        pictures = library.frame_cache.stereo(file)
        setup = read_clip_setup(file)
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
        body = await read_json(request)
        setup, file = ClipSetup(*_parse_setup(body), str(body.get("revision"))), library.file(clip)
        await run_in_threadpool(library.frame_cache.stereo, file)  # refuses documents that lead out of the folder
        saved = await run_in_threadpool(save_clip_setup, file, setup)
        return {"paths": saved.paths, "vehicles": saved.vehicles, "revision": saved.revision}

    @router.post("/api/check")
    async def check(clip: str, request: Request) -> dict[str, Any]:
        paths, vehicles = _parse_setup(await read_json(request))
        pictures = await run_in_threadpool(library.frame_cache.stereo, library.file(clip))
        checks = await run_in_threadpool(_check, pictures.clip.rig, json.dumps([paths, vehicles]))
        visible_vehicles = [
            facts if vehicle.get("frame") in (None, *pictures.frames)
            else {"problem": f"frame {str(vehicle['frame'])[:40]} is not in the recording; outline it in one that is"}
            for vehicle, facts in zip(vehicles, checks["vehicles"], strict=True)
        ]  # fmt: skip
        return {**checks, "vehicles": visible_vehicles}

    @router.post("/api/propose")
    async def propose_other(clip: str, request: Request) -> dict[str, Any]:
        body = await read_json(request)
        return await run_in_threadpool(_propose, library, clip, body)

    return router


@lru_cache(maxsize=64)
def _check(rig: StereoRig, drawn: str) -> dict[str, Any]:
    paths, vehicles = json.loads(drawn)
    return check_setup(rig, paths, vehicles)


def _propose(library: Library, clip: str, body: dict[str, Any]) -> dict[str, Any]:
    pictures = library.frame_cache.stereo(library.file(clip))
    view, frame = _parse_view(body.get("view")), parse_whole_number(body.get("frame"), 10**9)
    entry, path = _parse_entry(body.get("entry")), body.get("path")
    drawn = len(entry.get(VIEW_NAMES[view], []))
    if drawn < 2 if "shape" in entry else drawn != 4:
        raise UnusableInput("entry: expected a path with its shape and two points, or a vehicle with four corners")
    images = pictures.picture(0, frame), pictures.picture(1, frame)
    pixels, correlation = propose_in_other_view(
        pictures.clip.rig, view, images, entry, None if path is None else _parse_path(path)
    )
    return {"pixels": np.round(pixels, 2).tolist(), "correlation": round(correlation, 3)}


def _import_routes(library: Library, imports: Uploads) -> APIRouter:
    router = APIRouter()

    @router.post("/api/import")
    async def begin(request: Request) -> dict[str, str]:
        library.refuse_read_only()
        body = await read_json(request)
        return {"key": imports.begin(str(body.get("name", "")), body.get("kind") == "chase")}

    @router.put("/api/import/{key}/{slot}")
    async def receive(key: str, slot: str, name: str, request: Request) -> dict[str, str]:
        announced = request.headers.get("content-length", "")
        size = int(announced) if announced.isdecimal() else None
        await imports.receive(key, slot, name, size, request.stream())
        return {}

    @router.post("/api/import/{key}")
    async def finish(key: str, request: Request) -> dict[str, str]:
        rate = (await read_json(request)).get("rate")
        frame_rate = None if rate is None else parse_number(rate)
        return {"name": await run_in_threadpool(imports.finish, key, frame_rate)}

    @router.delete("/api/import/{key}")
    def discard(key: str) -> dict[str, str]:
        imports.discard(key)
        return {}

    @router.put("/api/rig")
    async def rig(clip: str, request: Request) -> dict[str, str]:
        library.refuse_read_only()
        content = await read_body(request.stream(), MAX_YAML_BYTES)
        await run_in_threadpool(add_rig, library.file(clip), content)
        return {}

    return router


def _run_routes(library: Library) -> APIRouter:
    router = APIRouter()

    @router.post("/api/run")
    async def start(clip: str, request: Request) -> dict[str, Any]:
        library.refuse_read_only()
        body = await read_json(request)
        kind, options = body.get("kind"), body.get("options", {})
        if kind not in RUN_KINDS or not isinstance(options, dict):
            raise UnusableInput(f"kind: expected one of {', '.join(RUN_KINDS)}")
        return _run_data(await run_in_threadpool(library.runs.start, clip, kind, command_options(kind, options)))

    @router.get("/api/run")
    def get(clip: str, number: int) -> dict[str, Any]:
        return _run_data(_find_run(library, clip, number))

    @router.delete("/api/run")
    def cancel(clip: str, number: int) -> dict[str, str]:
        library.runs.cancel(clip, _find_run(library, clip, number).number)
        return {}

    @router.get("/api/proposed")
    def proposed(clip: str, number: int) -> dict[str, Any]:
        run = _find_run(library, clip, number)
        if run.kind == LANES_RUN:
            return {"paths": read_paths_of_site(file_below(library.runs.folder(run), "site.yaml")), "vehicles": []}
        return {"paths": {}, "vehicles": read_clip_setup(library.runs.input_document(run)).vehicles}

    @router.get("/api/live")
    def live(clip: str, number: int, frame: int, view: int) -> Response:
        return _jpeg_response(library.runs.picture(_find_run(library, clip, number), frame, view))

    @router.get("/results/{clip}/{number}/{folder}/{stem}.jpg")
    def picture(clip: str, number: int, folder: str, stem: str) -> FileResponse:
        run = _find_run(library, decode_clip(clip), number)
        if folder not in PICTURE_FOLDERS:
            raise NotFound(folder)
        return FileResponse(file_below(library.runs.output_folder(run), picture_name(stem, folder)))

    @router.get("/results/{clip}/{number}/{name}")
    def result(clip: str, number: int, name: str, save: bool = False) -> FileResponse:
        run = _find_run(library, decode_clip(clip), number)
        if name not in RESULT_FILES:
            raise NotFound(name)
        file = file_below(library.runs.output_folder(run), name)
        answer = FileResponse(file, filename=name if save else None)
        if file.suffix == ".html":
            answer.headers["Content-Security-Policy"] = REPORT_SECURITY_POLICY
        return answer

    return router


def result_address(clip: str, number: int, name: str) -> str:
    """The address of a file of a run; the clip's name is encoded, as it may hold any characters."""
    return f"/results/{base64.urlsafe_b64encode(clip.encode()).decode().rstrip('=')}/{number}/{name}"


def decode_clip(address: str) -> str:
    """The clip's name in a `result_address`. Raises NotFound."""
    try:
        return base64.urlsafe_b64decode(address + "=" * (-len(address) % 4)).decode()
    except (binascii.Error, ValueError) as error:
        raise NotFound(address) from error


def _find_run(library: Library, clip: str, number: int) -> Run:
    run = library.runs.get(clip, number)
    if run is None:
        raise NotFound(f"{clip} {number}")
    return run


def _run_data(run: Run) -> dict[str, Any]:
    return {"number": run.number, "state": run.state, "reason": run.reason, "done": run.done, "total": run.total}


def _parse_setup(body: dict[str, Any]) -> tuple[dict[str, Entry], list[Entry]]:
    paths, vehicles = body.get("paths"), body.get("vehicles")
    if not isinstance(paths, dict) or not isinstance(vehicles, list):
        raise UnusableInput("expected paths by name and a list of vehicles")
    return {str(name): _parse_path(path) for name, path in paths.items()}, [_parse_entry(v) for v in vehicles]


def _parse_path(value: object) -> Entry:
    path = _parse_entry(value)
    if "shape" not in path:
        raise UnusableInput("a path: expected shape line or curve")
    if path.get("lateral_offset") is not None:
        parse_number(path["lateral_offset"])
    return path


def _parse_entry(value: object) -> Entry:
    if not isinstance(value, dict):
        raise UnusableInput("expected a path or a vehicle with its keys")
    for key, length in (("left", 2), ("right", 2), ("points", 3)):
        points = value.get(key, [])
        if not isinstance(points, list) or len(points) > MAX_DRAWN_POINTS:
            raise UnusableInput(f"{key}: expected a list of at most {MAX_DRAWN_POINTS} points")
        for point in points:
            if not isinstance(point, list) or len(point) != length:
                raise UnusableInput(f"{key}: expected points of {length} numbers")
            for number in point:
                parse_number(number)
    if value.get("shape", "line") not in ("line", "curve") or not isinstance(value.get("path", ""), str):
        raise UnusableInput("expected shape line or curve, and the name of a path")
    return value


def _parse_view(value: object) -> int:
    if value not in (0, 1):
        raise UnusableInput("view: expected 0 for left or 1 for right")
    return int(value)


def _jpeg_response(content: bytes) -> Response:
    return Response(content, media_type="image/jpeg", headers={"Cache-Control": "private, no-cache"})
