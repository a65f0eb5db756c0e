"""The HTTP routes of the target page: the model and its start, projected lines, models learned or uploaded."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool

from paceline.console.editing.follow_document import FollowSetup, read_follow_setup, save_follow_setup
from paceline.console.editing.target_model import (
    centred_start,
    learn_model,
    project_model,
    target_as_dict,
    validated_target,
)
from paceline.console.frames.uploads import MAX_YAML_BYTES
from paceline.console.library import Library
from paceline.console.request_body import read_body, read_json
from paceline.console.runs.options import parse_number, parse_whole_number
from paceline.documents.models import TargetModel, read_document
from paceline.errors import UnusableInput
from paceline.targets.stated_width import USUAL_WIDTHS, StatedWidth, checked_width


def target_router(library: Library) -> APIRouter:
    """The routes of the target page."""
    router = APIRouter()

    @router.get("/api/target")
    def get(clip: str) -> dict[str, Any]:
        file = library.file(clip)
        pictures = library.frame_cache.chase(file)
        return {
            "size": pictures.camera.image_size,
            "frames": pictures.frames,
            "times": [round(float(t), 4) for t in pictures.times],
            "notices": pictures.notices,
            "usual_widths": USUAL_WIDTHS,
            **_setup_data(library, read_follow_setup(file)),
        }

    @router.put("/api/target")
    async def put(clip: str, request: Request) -> dict[str, Any]:
        library.refuse_read_only()
        body, file = await read_json(request), library.file(clip)
        pictures = await run_in_threadpool(library.frame_cache.chase, file)
        start = body.get("start")
        if isinstance(start, dict):
            pictures.position_of(parse_whole_number(start.get("frame"), 10**9))
        setup = FollowSetup(body.get("target"), start, str(body.get("revision")))
        return _setup_data(library, await run_in_threadpool(save_follow_setup, file, pictures.camera, setup))

    @router.post("/api/outline")
    async def outline(clip: str, request: Request) -> dict[str, Any]:
        body = await read_json(request)
        camera = (await run_in_threadpool(library.frame_cache.chase, library.file(clip))).camera
        return await run_in_threadpool(project_model, camera, body.get("target"), body.get("start"))

    @router.post("/api/learn")
    async def learn(clip: str, request: Request) -> dict[str, Any]:
        body = await read_json(request)
        box = body.get("box")
        if not isinstance(box, list) or len(box) != 4:
            raise UnusableInput("box: expected x0, y0, x1, y1 in pixels")
        name = str(body.get("name") or "vehicle ahead")
        frame, width = parse_whole_number(body.get("frame"), 10**9), _stated_width(body)
        return await run_in_threadpool(_learn_model, library, clip, frame, [parse_number(v) for v in box], width, name)

    @router.post("/api/model")
    async def model(clip: str, frame: int, request: Request) -> dict[str, Any]:
        library.refuse_read_only()
        content, file = await read_body(request.stream(), MAX_YAML_BYTES), library.file(clip)
        camera = (await run_in_threadpool(library.frame_cache.chase, file)).camera
        target = await run_in_threadpool(_read_model, file.parent, content)
        return {"target": target_as_dict(target), "start": centred_start(camera, target, frame)}

    return router


def _stated_width(body: dict[str, Any]) -> StatedWidth:
    """The width in a request, with its uncertainty where that is stated. Raises UnusableInput."""
    half_width = body.get("half_width")
    try:
        return checked_width(parse_number(body.get("width")), None if half_width is None else parse_number(half_width))
    except UnusableInput as error:
        raise UnusableInput(str(error).replace("--", "")) from error


def _learn_model(
    library: Library, clip: str, frame: int, box: list[float], width: StatedWidth, name: str
) -> dict[str, Any]:
    pictures = library.frame_cache.chase(library.file(clip))
    learned = learn_model(pictures.camera, pictures.picture(0, frame), frame, box, width, name)
    validated_target(learned["target"])
    return learned


def _read_model(folder: Path, content: bytes) -> TargetModel:
    """The model in an uploaded file, which is kept in ``folder`` while it is read. Raises UnusableInput."""
    file = folder / f".target.{secrets.token_hex(4)}.partial"
    try:
        file.write_bytes(content)
        return validated_target(target_as_dict(read_document(TargetModel, file)))
    except OSError as error:
        raise UnusableInput(f"{folder}: cannot be written ({error.strerror})") from error
    except UnusableInput as error:
        raise UnusableInput(str(error).replace(str(file), "the model file")) from error
    finally:
        file.unlink(missing_ok=True)


def _setup_data(library: Library, setup: FollowSetup) -> dict[str, Any]:
    problem = library.relative_message(UnusableInput(setup.problem))
    return {"target": setup.target, "start": setup.start, "revision": setup.revision, "problem": problem}
