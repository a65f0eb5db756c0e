"""A simulated operator: draws the outlines of vehicles, the painted line beside each lane, and a target's start.

The operator is given the ground truth and a test for occluded points, but no renderer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from paceline.arrays import Array, Mask
from paceline.cameras import Camera, PosedCamera, StereoRig
from paceline.errors import UnusableInput
from paceline.simulation.road import Road

MIN_OUTLINE_VISIBLE_SHARE = 0.97  # of a plane, in the frame in which it is outlined
MIN_OUTLINE_WIDTH_PX = 24.0  # of a plane, in the frame in which it is outlined
LINE_BEFORE_M = 60.0  # of a line drawn nearer to the camera than the vehicle drives
LINE_BEYOND_M = 6.0  # of a line drawn farther from the camera than the vehicle drives
LINE_BORDER_PX = 6.0  # between a line's points and the border of the image
MIN_BORDER_DISTANCE_PX = 10.0  # of a quadrilateral that counts as inside the image

IsHidden = Callable[[PosedCamera, Array], Mask]  # whether (N,) a static object hides points (N, 3) from a view


@dataclass(frozen=True)
class OperatorNoise:
    """Standard deviations of what an operator draws: the corners and the points of lines of a stereo clip (px), and the
    center (px) and the scale (relative) at which a target is started."""

    corner_px: float = 0.5
    line_px: float = 0.4
    center_px: float = 0.4
    scale: float = 0.008


OPERATOR_NOISE = OperatorNoise()


class VehicleMotion(Protocol):
    def position(self, t: float) -> tuple[float, float]:
        """Arc length and lateral, m."""


class SimulatedVehicle(Protocol):
    """A vehicle as far as the operator needs it."""

    @property
    def model(self) -> Any: ...
    @property
    def motion(self) -> VehicleMotion: ...


class SimulatedStereoScene(Protocol):
    """A scene before a stereo rig as far as the operator needs it."""

    @property
    def scene(self) -> Any: ...
    @property
    def road(self) -> Road: ...
    @property
    def rig(self) -> StereoRig: ...
    @property
    def views(self) -> tuple[PosedCamera, PosedCamera]: ...
    @property
    def vehicles(self) -> Sequence[SimulatedVehicle]: ...
    def first_pixels(self, i: int, points: Array) -> Array:
        """Ideal pixels (N, 2) at which the first picture of view ``i`` shows ``points`` (N, 3) that stand still."""


def clip_document(placed: SimulatedStereoScene, truth: list[dict[str, Any]], hidden: IsHidden) -> dict[str, Any]:
    """The contents of clip.yaml, pixels as recorded.

    Raises UnusableInput where a measured vehicle or the line beside it is never seen well enough.
    """
    scene, rng = placed.scene, np.random.default_rng([placed.scene.seed, 13])
    video = scene.is_video
    clip: dict[str, Any] = {side: f"{side}.mp4" if video else side for side in ("left", "right")}
    if not video:
        clip |= {"times": "times.csv"} if scene.dropped or scene.skew else {"rate": scene.rate}
    if not scene.skew:
        clip["synchronised"] = True
    clip["rig"] = "rig.yaml"
    lanes: dict[tuple[int, bool], str] = {}
    measured = [car for car in placed.vehicles if car.model.measured]
    for car in measured:
        lanes.setdefault((car.model.lane, car.model.oncoming), f"lane{len(lanes)}")
    visible_rows = {car.model.id: rows_from_outline(car, truth) for car in measured}
    clip["paths"] = {}
    for (lane, oncoming), name in lanes.items():
        users = [car for car in measured if (car.model.lane, car.model.oncoming) == (lane, oncoming)]
        driven = np.array([_arc_length(car, row["time_s"]) for car in users for row in visible_rows[car.model.id]])
        clip["paths"][name] = _draw_path(placed, lane, oncoming, driven, hidden, rng)
    clip["vehicles"] = [
        {
            "id": car.model.id,
            "path": lanes[car.model.lane, car.model.oncoming],
            "frame": visible_rows[car.model.id][0]["frame"],
        }
        | {side: _draw_corners(placed, side, visible_rows[car.model.id][0][side], rng) for side in ("left", "right")}
        | ({"speed": car.model.initial_speed} if car.model.initial_speed else {})
        for car in measured
    ]
    return clip


def rows_from_outline(car: SimulatedVehicle, truth: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of truth from the first on in which a vehicle can be outlined, while it is inside both pictures."""
    rows = [row for row in truth if row["vehicle"] == car.model.id and row["inside"]]
    for i, row in enumerate(rows):
        width = outline_width([np.array(row[side]) for side in ("left", "right")])
        if row["visible"] >= MIN_OUTLINE_VISIBLE_SHARE and width >= MIN_OUTLINE_WIDTH_PX:
            return rows[i:]
    raise never_outlined(car)


def outline_width(views: Sequence[Array]) -> float:
    """The width of an outline, px, in the view in which it is narrower: its corners (4, 2) in each of the ``views``."""
    return float(min(np.ptp(corners[:, 0]) for corners in views))


def never_outlined(car: SimulatedVehicle) -> UnusableInput:
    """Why a vehicle cannot be measured."""
    return UnusableInput(
        f"vehicle {car.model.id}: is never wholly visible and {MIN_OUTLINE_WIDTH_PX:g} px wide in both pictures"
    )


def _arc_length(car: SimulatedVehicle, t: float) -> float:
    return car.motion.position(t)[0]


def _draw_corners(
    placed: SimulatedStereoScene, side: str, corners: list[list[float]], rng: np.random.Generator
) -> list[list[float]]:
    camera = placed.rig.left if side == "left" else placed.rig.right
    return add_drawing_noise(camera.distort_points(np.array(corners)), placed.scene.operator_noise.corner, rng)


def add_drawing_noise(pixels: Array, sigma: float, rng: np.random.Generator) -> list[list[float]]:
    """``pixels`` (N, 2) as an operator draws them, with an error of std ``sigma`` px in each coordinate."""
    return round_points(pixels + rng.normal(0, 1, pixels.shape) * sigma)


def draw_line(pixels: Array, camera: Camera, points: int, sigma: float, rng: np.random.Generator) -> list[list[float]]:
    """About ``points`` points that an operator draws along a line of ideal ``pixels`` (N, 2), from far to near."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    # People draw points more densely far away, where a line bends in the picture: evenly in the root of the length.
    count = points + int(rng.integers(-1, 2))
    lengths = length[-1] * ((np.arange(count) + rng.uniform(0.1, 0.9, count)) / count) ** 2
    return add_drawing_noise(
        camera.distort_points(np.column_stack([np.interp(lengths, length, c) for c in pixels.T])), sigma, rng
    )


def _draw_path(
    placed: SimulatedStereoScene, lane: int, oncoming: bool, driven: Array, hidden: IsHidden, rng: np.random.Generator
) -> dict[str, Any]:
    """The best visible painted line beside a lane, drawn in each view along the arc lengths ``driven`` (N,) m of its
    vehicles."""
    marking, lines = visible_marking(placed, lane, driven, hidden)
    if min(len(line) for line in lines) < 10:
        raise UnusableInput(f"no painted line beside lane {lane} is visible in both pictures")
    shape = placed.road.shape
    path: dict[str, Any] = {"shape": "line" if shape.kind == "straight" and shape.crest_radius is None else "curve"}
    for side, camera, pixels in zip(("left", "right"), placed.rig.cameras, lines, strict=True):
        path[side] = draw_line(
            pixels, camera, placed.scene.operator_noise.points, placed.scene.operator_noise.line, rng
        )
    path["lateral_offset"] = round((placed.road.lanes[lane] - marking) * (-1.0 if oncoming else 1.0), 3)
    return path


def visible_marking(
    placed: SimulatedStereoScene, lane: int, driven: Array, hidden: IsHidden
) -> tuple[float, list[Array]]:
    """The lateral (m) of the best visible painted line beside a lane, along the arc lengths ``driven`` (N,) m of its
    vehicles, and its pixels (M, 2), closely, from far to near, in each view."""
    middle, markings = placed.road.lanes[lane], placed.road.markings
    nearest_markings = sorted(markings, key=lambda m: abs(m - middle))[:2]
    lines = {m: [_visible_line(placed, m, driven, i, hidden) for i in (0, 1)] for m in nearest_markings}
    marking = max(lines, key=lambda m: min(len(line) for line in lines[m]))
    return marking, lines[marking]


def _visible_line(placed: SimulatedStereoScene, marking: float, driven: Array, i: int, hidden: IsHidden) -> Array:
    """Pixels (N, 2) closely along the line at ``marking`` in the first picture of view ``i``, from far to near, where
    nothing hides it: its longest stretch."""
    view = placed.views[i]
    points = placed.road.line(marking, float(driven.min()) - LINE_BEFORE_M, float(driven.max()) + LINE_BEFORE_M, 0.25)
    depth = view.to_camera(points)[:, 2]
    along = placed.road.line(0.0, float(driven.min()), float(driven.max()), 0.25)
    nearest, farthest = (f(view.to_camera(along)[:, 2]) for f in (np.min, np.max))
    points = points[(depth > max(2.0, nearest - LINE_BEFORE_M)) & (depth < farthest + LINE_BEYOND_M)]
    points = points[np.argsort(-view.to_camera(points)[:, 2], kind="stable")]
    if len(points) == 0:
        return np.empty((0, 2))
    pixels = placed.first_pixels(i, points)
    size = np.array(view.camera.image_size)
    is_visible = ((pixels > LINE_BORDER_PX) & (pixels < size - 1 - LINE_BORDER_PX)).all(1) & ~hidden(view, points)
    # A post hides only a short part of a line, and people draw across it; a curve may leave the picture and come back.
    closed = np.convolve(is_visible, np.ones(9), "same") > 0
    inside = closed & ((pixels > LINE_BORDER_PX) & (pixels < size - 1 - LINE_BORDER_PX)).all(1)
    return longest_visible_run(pixels, inside)


def draw_start(
    center: Array, distance: float, nominal_range: float, seed: int, focal: float = 1.0, reference_focal: float = 1.0
) -> dict[str, Any]:
    """``start`` of follow.yaml with the operator's noise, for the first frame, in which the target's ``center`` (2,) px
    is ``distance`` m away. The noise of the center is proportional to ``focal`` over ``reference_focal``."""
    rng = np.random.default_rng([seed, 47])
    x, y = center + rng.normal(0, OPERATOR_NOISE.center_px, 2) * focal / reference_focal
    scale = nominal_range / distance * (1 + rng.normal(0, OPERATOR_NOISE.scale))
    return {"frame": 0, "center": [round(float(x), 1), round(float(y), 1)], "scale": round(float(scale), 3)}


def longest_visible_run(pixels: Array, is_visible: Mask) -> Array:
    """The longest part (M, 2) of a line of ``pixels`` (N, 2) that is ``is_visible`` (N,) without a gap."""
    pieces = np.split(pixels, np.flatnonzero(~is_visible))
    return np.asarray(max((p[1:] if i else p for i, p in enumerate(pieces)), key=len, default=np.empty((0, 2))))


def is_inside_image(pixels: Array, size: tuple[int, int]) -> bool:
    """Whether ``pixels`` (…, 2) lie wholly inside an image of ``size``, away from its border."""
    return bool(
        (pixels >= MIN_BORDER_DISTANCE_PX).all() and (pixels <= np.array(size) - 1 - MIN_BORDER_DISTANCE_PX).all()
    )


def round_points(points: Array) -> list[list[float]]:
    return [[round(float(x), 2), round(float(y), 2)] for x, y in points]
