"""The line model of the vehicle ahead in the image: its projection, and models learned from a drawn box."""

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
from paceline.targets.stated_width import StatedWidth

Plain = dict[str, Any]

POINTS_PER_LINE = 5  # points of the displayed polyline, which lens distortion bends
MIN_RECOMMENDED_LINES = 8  # number of lines below which another vehicle may match
INITIAL_WIDTH_SHARE = 0.25  # width of a model that is not placed yet, as a share of the image width


def validated_target(target: object) -> TargetModel:
    """The validated ``target`` of a target.yaml. Raises UnusableInput, naming the key."""
    try:
        model = TargetModel.model_validate(target)
    except ValidationError as error:
        raise UnusableInput(f"target: {_first_error(error)}") from error
    for i, (a, b) in enumerate(model.segments):
        if problem := check_segment(a, b, model.corners):
            raise UnusableInput(f"segments[{i}]: {problem}")
    ends = np.array([[model.corners[a], model.corners[b]] for a, b in model.segments]).reshape(-1, 2, 2)
    if problem := check_target(ends):
        raise UnusableInput(f"segments: {problem}")
    return model


def validated_start(camera: Camera, target: TargetModel, start: object) -> StartModel:
    """The validated ``start`` of a follow.yaml. Raises UnusableInput, naming the key."""
    try:
        model = StartModel.model_validate(start)
    except ValidationError as error:
        raise UnusableInput(f"start: {_first_error(error)}") from error
    ends = np.array([target.corners[name] for pair in target.segments for name in pair])
    if problem := check_start(model.center, model.scale, ends * _magnification(camera, target), camera.image_size):
        raise UnusableInput(f"{problem[0]}: {problem[1]}")
    return model


def project_model(camera: Camera, target: object, start: object) -> Plain:
    """Projects the model's lines into the image as recorded, (S, POINTS_PER_LINE, 2) px, and gives its distance and
    size; ``problem`` where it cannot be followed from there, ``warning`` where following it is unlikely to work."""
    model = validated_target(target)
    try:
        place = StartModel.model_validate(start)
    except ValidationError as error:
        raise UnusableInput(f"start: {_first_error(error)}") from error
    ends = np.array([[model.corners[a], model.corners[b]] for a, b in model.segments])
    share = np.linspace(0, 1, POINTS_PER_LINE)[:, None]
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
        validated_start(camera, model, start)
    except UnusableInput as error:
        facts["problem"] = str(error)
    if len(model.segments) < MIN_RECOMMENDED_LINES:
        facts["warning"] = f"{len(model.segments)} lines are few: {MIN_RECOMMENDED_LINES} or more are recommended"
    return facts


def learn_model(camera: Camera, picture: Image, frame: int, box: list[float], width: StatedWidth, name: str) -> Plain:
    """Learns a model from the lines inside a ``box`` (x0, y0, x1, y1) of a ``frame``'s ``picture`` that has this
    ``width``; returns it with its start and notices. Raises UnusableInput."""
    x0, y0, x1, y1 = box
    try:
        learned = learn_target(picture, (x0, y0, x1, y1), width, camera, name)
    except UnusableInput as error:
        raise UnusableInput(str(error).replace("--", "")) from error
    names = corner_names(len(learned.target.corners))
    target = {
        "name": name,
        "nominal_range": learned.target.nominal_range,
        "corners": {n: np.round(corner, 4).tolist() for n, corner in zip(names, learned.target.corners, strict=True)},
        "segments": [[names[a], names[b]] for a, b in learned.target.segments],
        "tolerance": learned.target.tolerance,
    }
    if learned.target.width_assumed:
        target["width_assumed"] = True
    start = {"frame": frame, "center": learned.center.tolist(), "scale": 1.0}
    notices = [f"{notice}. {notice.advice}" for notice in learned.notices]
    doubted = bool(learned.quality.doubts())
    return {"target": target, "start": start, "quality": str(learned.quality), "doubted": doubted, "notices": notices}


def centred_start(camera: Camera, target: TargetModel, frame: int) -> Plain:
    """A start in the middle of the image, at INITIAL_WIDTH_SHARE."""
    corners = np.array(list(target.corners.values()))
    width = float(np.ptp(corners[:, 0]) * _magnification(camera, target)[0])
    middle = [(size - 1) / 2 for size in camera.image_size]
    return {
        "frame": frame,
        "center": middle,
        "scale": round(INITIAL_WIDTH_SHARE * camera.image_size[0] / max(width, 1e-6), 4),
    }


def target_as_dict(model: TargetModel) -> Plain:
    """``model`` as plain JSON and YAML values."""
    corners = {name: corner.tolist() for name, corner in model.corners.items()}
    return {**model.model_dump(exclude={"corners"}, exclude_none=True), "corners": corners, "segments": model.segments}


def _magnification(camera: Camera, target: TargetModel) -> Array:
    """(2,) px per metre along x and y at scale 1."""
    return np.array([camera.K[0, 0], camera.K[1, 1]]) / target.nominal_range


def _first_error(error: ValidationError) -> str:
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"] if part != "[key]")
    return f"{key}: {first['msg'].removeprefix('Value error, ')}"
