"""What the target page asks for and sends: the model and its start, where its lines are, models learned or opened."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool

from paceline.console.editing.follow_document import Chase, read_chase, save_chase
from paceline.console.editing.target_model import checked_target, learned, outlined, placed, plain_target
from paceline.console.frames.uploads import LARGEST_RIG
from paceline.console.library import Library
from paceline.console.request_body import received, received_json
from paceline.console.runs.options import to_number, to_whole
from paceline.documents.models import TargetModel, read_document
from paceline.errors import UnusableInput


def target_router(library: Library) -> APIRouter:
    """The addresses of the target page."""
    router = APIRouter()

    @router.get("/api/target")
    def get(clip: str) -> dict[str, Any]:
        file = library.file(clip)
        pictures = library.gallery.chase(file)
        return {
            "size": pictures.camera.image_size,
            "frames": pictures.frames,
            "times": [round(float(t), 4) for t in pictures.times],
            "notices": pictures.notices,
            **_shown(library, read_chase(file)),
        }

    @router.put("/api/target")
    async def put(clip: str, request: Request) -> dict[str, Any]:
        library.refuse_read_only()
        body, file = await received_json(request), library.file(clip)
        pictures = await run_in_threadpool(library.gallery.chase, file)
        start = body.get("start")
        if isinstance(start, dict):
            pictures.place_of(to_whole(start.get("frame"), 10**9))
        chase = Chase(body.get("target"), start, str(body.get("revision")))
        return _shown(library, await run_in_threadpool(save_chase, file, pictures.camera, chase))

    @router.post("/api/outline")
    async def outline(clip: str, request: Request) -> dict[str, Any]:
        body = await received_json(request)
        camera = (await run_in_threadpool(library.gallery.chase, library.file(clip))).camera
        return await run_in_threadpool(outlined, camera, body.get("target"), body.get("start"))

    @router.post("/api/learn")
    async def learn(clip: str, request: Request) -> dict[str, Any]:
        body = await received_json(request)
        box = body.get("box")
        if not isinstance(box, list) or len(box) != 4:
            raise UnusableInput("box: expected x0, y0, x1, y1 in pixels")
        name = str(body.get("name") or "vehicle ahead")
        frame, width = to_whole(body.get("frame"), 10**9), to_number(body.get("width"))
        return await run_in_threadpool(_learn, library, clip, frame, [to_number(v) for v in box], width, name)

    @router.post("/api/model")
    async def model(clip: str, frame: int, request: Request) -> dict[str, Any]:
        library.refuse_read_only()
        content, file = await received(request.stream(), LARGEST_RIG), library.file(clip)
        camera = (await run_in_threadpool(library.gallery.chase, file)).camera
        target = await run_in_threadpool(_opened, file.parent, content)
        return {"target": plain_target(target), "start": placed(camera, target, frame)}

    return router


def _learn(library: Library, clip: str, frame: int, box: list[float], width: float, name: str) -> dict[str, Any]:
    pictures = library.gallery.chase(library.file(clip))
    found = learned(pictures.camera, pictures.picture(0, frame), frame, box, width, name)
    checked_target(found["target"])
    return found


def _opened(folder: Path, content: bytes) -> TargetModel:
    """The model in a file that a person gave, which lies in ``folder`` while it is read. Raises UnusableInput."""
    file = folder / f".target.{secrets.token_hex(4)}.partial"
    try:
        file.write_bytes(content)
        return checked_target(plain_target(read_document(TargetModel, file)))
    except OSError as error:
        raise UnusableInput(f"{folder}: cannot be written ({error.strerror})") from error
    except UnusableInput as error:
        raise UnusableInput(str(error).replace(str(file), "the model file")) from error
    finally:
        file.unlink(missing_ok=True)


def _shown(library: Library, chase: Chase) -> dict[str, Any]:
    problem = library.shown(UnusableInput(chase.problem))
    return {"target": chase.target, "start": chase.start, "revision": chase.revision, "problem": problem}
