"""Clips of a chase camera behind a vehicle, with exact truth, fast enough for runs of a quarter of an hour.

``render_frames(random_chase(seed))`` yields image after image with its truth; ``write`` writes a clip's files.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.simulation.chase.renderer import Renderer
from paceline.simulation.chase.scene import CHASE_PRESETS, ChaseScene, Occlusion
from paceline.simulation.chase.script import ChaseScript
from paceline.simulation.chase.world import WorldState, lead_body
from paceline.simulation.operator import draw_start

__all__ = [
    "CHASE_PRESETS",
    "ChaseScene",
    "ChaseTruth",
    "Occlusion",
    "camera_document",
    "render_frames",
    "start_document",
    "target_document",
    "truth_of",
    "write",
]


NOMINAL_RANGE_M = 10.0  # m


@dataclass(frozen=True, eq=False)
class ChaseTruth:
    """The truth of one frame: the centre of the lead's rear plane (3,) in camera axes (m) and in the image (2,) px, its
    corners (4, 2) px, the part of it that is visible, and the camera in plan: x and y in m, heading in rad from x to y
    with y to the left of x."""

    frame: int
    time: float
    position: Array
    center: Array
    corners: Array
    visible: float
    x: float
    y: float
    heading: float
    braking: bool


def render_frames(scene: ChaseScene) -> Iterator[tuple[NDArray[np.uint8], ChaseTruth]]:
    """Picture (H, W) and truth, frame by frame; the same scene gives the same pictures. Nothing is kept of the frames
    before."""
    script = ChaseScript(scene)
    renderer = Renderer(script.world)
    for frame in range(scene.frames):
        state = script.state_at(frame / scene.rate)
        image, visible = renderer.render(state, script.state_at)
        yield image, truth_of(scene, frame, state, visible)


def truth_of(scene: ChaseScene, frame: int, m: WorldState, visible: float) -> ChaseTruth:
    """The truth of the picture of a moment."""
    center = scene.camera.project(m.position)
    camera = m.camera
    return ChaseTruth(
        frame, m.time, m.position, center, m.corners, visible, camera.x, camera.y, camera.heading, m.braking
    )


def camera_document(scene: ChaseScene) -> dict[str, Any]:
    """The contents of camera.yaml."""
    return {"image_size": list(scene.image_size), "K": scene.camera.K.tolist(), "shutter": "global"}


def target_document(scene: ChaseScene) -> dict[str, Any]:
    """The contents of target.yaml: the strong edges of the lead's rear as they appear from `NOMINAL_RANGE_M`."""
    body, rng = lead_body(scene), np.random.default_rng([scene.seed, 43])
    below = scene.camera_height - body.clearance - body.height / 2  # the plane's centre, under the camera
    corners: dict[tuple[float, float], str] = {}
    segments = []
    for line in body.lines:
        shrink = NOMINAL_RANGE_M / (NOMINAL_RANGE_M + line.z)
        ends = np.array([[line.x0, line.y0], [line.x1, line.y1]]) * shrink
        ends[:, 1] += below * (shrink - 1)
        ends[:, 0 if line.x0 == line.x1 else 1] += rng.normal(0, scene.model_error)
        places = [(round(float(x), 4), round(float(y), 4)) for x, y in ends]
        segments.append([corners.setdefault(p, f"c{len(corners)}") for p in places])
    return {
        "name": body.kind,
        "nominal_range": NOMINAL_RANGE_M,
        "corners": {name: list(place) for place, name in corners.items()},
        "segments": segments,
    }


def start_document(scene: ChaseScene, first: ChaseTruth) -> dict[str, Any]:
    """``start`` of follow.yaml, as an operator would set it on the first frame."""
    distance = float(first.position[2])
    return draw_start(first.center, distance, NOMINAL_RANGE_M, scene.seed, scene.focal, ChaseScene.focal)


def write(scene: ChaseScene, directory: Path | str) -> Path:
    """Write frames/, camera.yaml, target.yaml, odometry.csv, follow.yaml and truth.json into ``directory``; returns the
    path of follow.yaml."""
    directory = Path(directory)
    (directory / "frames").mkdir(parents=True, exist_ok=True)
    rows, odometry, start = [], [], None
    for image, truth in render_frames(scene):
        name = str(directory / "frames" / f"{truth.frame:05d}.png")
        cv2.imwrite(name, image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        start = start or start_document(scene, truth)
        rows.append(_truth_row(truth))
        odometry.append([truth.frame, round(truth.x, 4), round(truth.y, 4), round(truth.heading, 6)])
    follow = {
        "video": "frames",
        "rate": scene.rate,
        "camera": "camera.yaml",
        "target": "target.yaml",
        "start": start,
        "odometry": "odometry.csv",
    }
    documents = {"camera": camera_document(scene), "target": target_document(scene), "follow": follow}
    for name, document in documents.items():
        (directory / f"{name}.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    (directory / "truth.json").write_text(json.dumps(rows))
    with (directory / "odometry.csv").open("w", newline="") as f:
        csv.writer(f).writerows([["frame", "x_m", "y_m", "heading_rad"], *odometry])
    return directory / "follow.yaml"


def _truth_row(truth: ChaseTruth) -> dict[str, Any]:
    return {
        "frame": truth.frame,
        "time_s": truth.time,
        "position": truth.position.tolist(),
        "corners": truth.corners.tolist(),
        "center": truth.center.tolist(),
        "width_px": float(np.linalg.norm(truth.corners[1] - truth.corners[0])),
        "visible": truth.visible,
        "chase": {"x_m": truth.x, "y_m": truth.y, "heading_rad": truth.heading},
    }
