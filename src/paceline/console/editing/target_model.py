"""The line model of the vehicle ahead on the camera's picture: where its lines are, and models learned from a box."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import ValidationError

from paceline.arrays import Array, Image
from paceline.cameras import Camera
from paceline.documents.models import StartModel, TargetModel
from paceline.documents.plausibility import check_segment, check_start, check_target
from paceline.errors import UnusableInput
from paceline.targets.learning import corner_names, learn_target

Plain = dict[str, Any]

ALONG = 5  # places of each line that are shown: a lens bends it
FEW = 8  # lines below which a vehicle may be taken for another
USUAL = 0.25  # of the picture's width: how large a model is first shown


def checked_target(target: object) -> TargetModel:
    """``target`` as target.yaml may hold it. Raises UnusableInput, naming the key."""
    try:
        model = TargetModel.model_validate(target)
    except ValidationError as error:
        raise UnusableInput(f"target: {_first(error)}") from error
    for i, (a, b) in enumerate(model.segments):
        if wrong := check_segment(a, b, model.corners):
            raise UnusableInput(f"segments[{i}]: {wrong}")
    ends = np.array([[model.corners[a], model.corners[b]] for a, b in model.segments]).reshape(-1, 2, 2)
    if wrong := check_target(ends):
        raise UnusableInput(f"segments: {wrong}")
    return model


def checked_start(camera: Camera, target: TargetModel, start: object) -> StartModel:
    """``start`` as follow.yaml may hold it. Raises UnusableInput, naming the key."""
    try:
        model = StartModel.model_validate(start)
    except ValidationError as error:
        raise UnusableInput(f"start: {_first(error)}") from error
    ends = np.array([target.corners[name] for pair in target.segments for name in pair])
    if wrong := check_start(model.center, model.scale, ends * _magnification(camera, target), camera.image_size):
        raise UnusableInput(f"{wrong[0]}: {wrong[1]}")
    return model


def outlined(camera: Camera, target: object, start: object) -> Plain:
    """Where the model's lines are in the picture as recorded, (S, ALONG, 2) px, with what it is in space; ``problem``
    where it cannot be followed from there, ``doubt`` where that is unlikely to work."""
    model = checked_target(target)
    try:
        place = StartModel.model_validate(start)
    except ValidationError as error:
        raise UnusableInput(f"start: {_first(error)}") from error
    ends = np.array([[model.corners[a], model.corners[b]] for a, b in model.segments])
    share = np.linspace(0, 1, ALONG)[:, None]
    metres = ends[:, :1] * (1 - share) + ends[:, 1:] * share
    with np.errstate(all="ignore"):
        ideal = camera.undistort_points(place.center) + place.scale * _magnification(camera, model) * metres
        lines = camera.distort_points(ideal.reshape(-1, 2)).reshape(metres.shape)
    low, high = metres.reshape(-1, 2).min(axis=0), metres.reshape(-1, 2).max(axis=0)
    size = place.scale * _magnification(camera, model) * (high - low)
    facts: Plain = {
        "lines": np.nan_to_num(np.round(lines, 2), nan=-1e4, posinf=1e4, neginf=-1e4).tolist(),
        "range_m": model.nominal_range / place.scale,
        "size_m": np.round(high - low, 2).tolist(),
        "size_px": np.round(size, 1).tolist(),
    }
    try:
        checked_start(camera, model, start)
    except UnusableInput as error:
        facts["problem"] = str(error)
    if len(model.segments) < FEW:
        facts["doubt"] = f"{len(model.segments)} lines are few to tell a vehicle by; {FEW} or more are better"
    return facts


def learned(camera: Camera, picture: Image, frame: int, box: list[float], width: float, name: str) -> Plain:
    """The model of what a ``box`` (x0, y0, x1, y1) in the ``picture`` of a ``frame`` encloses, ``width`` m wide, and
    where it starts. Raises UnusableInput."""
    x0, y0, x1, y1 = box
    try:
        found = learn_target(picture, (x0, y0, x1, y1), width, camera, name)
    except UnusableInput as error:
        raise UnusableInput(str(error).replace("--", "")) from error
    names = corner_names(len(found.target.corners))
    target = {
        "name": name,
        "nominal_range": found.target.nominal_range,
        "corners": {n: np.round(corner, 4).tolist() for n, corner in zip(names, found.target.corners, strict=True)},
        "segments": [[names[a], names[b]] for a, b in found.target.segments],
        "tolerance": found.target.tolerance,
    }
    return {"target": target, "start": {"frame": frame, "center": found.center.tolist(), "scale": 1.0}}


def placed(camera: Camera, target: TargetModel, frame: int) -> Plain:
    """A start in the middle of the picture, for a person to move it."""
    corners = np.array(list(target.corners.values()))
    width = float(np.ptp(corners[:, 0]) * _magnification(camera, target)[0])
    middle = [(size - 1) / 2 for size in camera.image_size]
    return {"frame": frame, "center": middle, "scale": round(USUAL * camera.image_size[0] / max(width, 1e-6), 4)}


def plain_target(model: TargetModel) -> Plain:
    """``model`` as values that JSON and YAML know."""
    corners = {name: corner.tolist() for name, corner in model.corners.items()}
    return {**model.model_dump(exclude={"corners"}, exclude_none=True), "corners": corners, "segments": model.segments}


def _magnification(camera: Camera, target: TargetModel) -> Array:
    """(2,) px per metre along x and y at scale 1."""
    return np.array([camera.K[0, 0], camera.K[1, 1]]) / target.nominal_range


def _first(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"] if part != "[key]")
    return f"{where}: {first['msg'].removeprefix('Value error, ')}"
