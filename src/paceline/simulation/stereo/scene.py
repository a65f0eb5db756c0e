"""The geometry of a stereo scene: a flat road, vehicles that drive along it, and the rig.

Implemented independently of the measuring code, so that an error in one shows as a difference from the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.interpolate import CubicSpline

from paceline.arrays import Array
from paceline.cameras import Camera, PosedCamera, Quantity, StereoRig
from paceline.simulation.camera_errors import StereoErrors
from paceline.simulation.lane_change import LaneChange
from paceline.simulation.operator import OPERATOR_NOISE, longest_visible_run
from paceline.simulation.road import CircularAxis

PLANE_CLEARANCE_M = 0.35  # m from the road to the lower edge of a vehicle's main plane


@dataclass(frozen=True)
class Vehicle:
    """A vehicle whose main plane — front, rear or side, ``width`` × ``height`` metres — is what a clip shows of it.

    ``speed`` (m/s, positive) is that of the plane's centre along its own path at time 0; it changes by ``acceleration``
    (m/s²) from ``acceleration_start`` s on, all the time where that is 0.
    ``start_distance`` is the arc length along the road at time 0, in metres; see `Scene`. ``lane`` (m) puts the
    centre line of its lane to the right of the road's axis as seen towards growing arc length; ``lateral`` is what
    the vehicle deviates from that, in the same sense, and no drawing knows of. It drives at ``heading_error`` (rad,
    positive to the right of travel) to its lane. ``relief`` (m) is how far lamps, grille and plate lie before or
    behind the main plane at most. ``initial_speed`` is the first guess of the speed that the clip states, m/s.
    """

    id: str
    speed: float
    acceleration: float = 0.0
    start_distance: float = 70.0
    receding: bool = False
    width: float = 1.8
    height: float = 0.65
    plane: str = "front"  # front | side
    lane: float = 0.0
    lateral: float = 0.0
    texture_seed: int = 0
    heading_error: float = 0.0
    relief: float = 0.0
    lane_change: LaneChange | None = None
    glare: bool = False
    initial_speed: float | None = None
    acceleration_start: float = 0.0


@dataclass(frozen=True)
class Scene:
    """A road, a rig and vehicles.

    The camera stands ``camera_height`` metres above the road and looks down by ``tilt`` (rad). The road's axis passes
    at ``road_offset`` metres to the right of the optical axis where it is ``road_depth`` metres ahead; there it
    points ``road_direction`` (rad) to the right of the view, and arc length along it equals ``road_depth``. Beyond and
    before it follows a circle of ``radius`` metres, turning right (positive) or left (negative) as arc length grows,
    or runs straight (None).

    Grey levels: ``noise_sigma`` is the standard deviation of the sensor's noise, to whose variance ``shot_noise`` adds
    its part per grey level; ``gain_drift`` is the amplitude of the slow change of exposure. They go as light, which
    the lens blurs by ``blur_sigma`` (px), to the power 1 / ``gamma``. ``line_offset`` puts the
    drawn line that many metres to the right of each lane's centre as seen towards growing arc length.

    ``dropped`` are the ticks of the clock whose pictures are missing; the right camera fires ``skew_s``
    seconds after the left. ``errors`` are what is not ideal about the cameras and no file says.
    """

    seed: int
    vehicles: tuple[Vehicle, ...]
    image_size: tuple[int, int] = (1024, 768)
    focal: float = 2200.0
    baseline: float = 0.5
    rotation_sigma: float = 0.006
    camera_height: float = 1.8
    tilt: float = 0.0
    rate: float = 5.0
    frames: int = 12
    radius: float | None = None
    road_direction: float = 0.0
    road_offset: float = 0.0
    road_depth: float = 0.0
    line_offset: float = -1.85
    draw_path: bool = True
    click_sigma: float = OPERATOR_NOISE.corner_px
    line_sigma: float = OPERATOR_NOISE.line_px
    line_points: int = 20
    noise_sigma: float = 1.5
    shot_noise: float = 0.0
    blur_sigma: float = 0.6
    gamma: float = 1.0
    gain_drift: float = 0.0
    occluder: bool = False
    dropped: tuple[int, ...] = ()
    skew_s: float = 0.0
    errors: StereoErrors = StereoErrors()


class PlacedRoad:
    """The road of a scene, flat, in the left camera's frame."""

    def __init__(self, scene: Scene) -> None:
        c, s = np.cos(scene.tilt), np.sin(scene.tilt)
        self.level = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])  # columns: right, down, ahead of a level observer
        self.down = self.level[:, 1]
        self.axis = CircularAxis(1 / scene.radius if scene.radius else 0.0)
        yaw = scene.road_direction
        self.ahead = self.level @ np.array([np.sin(yaw), 0.0, np.cos(yaw)])
        self.right = self.level @ np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
        self.anchor = self.level @ np.array([scene.road_offset, scene.camera_height, scene.road_depth])
        self.anchor_arc = scene.road_depth

    def frame(self, s: Array) -> tuple[Array, Array]:
        """Unit vectors (…, 3) along the road and to its right at arc lengths ``s`` (…)."""
        heading = self.axis.pose(s - self.anchor_arc)[2][..., None]
        cosine, sine = np.cos(heading), np.sin(heading)
        return cosine * self.ahead - sine * self.right, cosine * self.right + sine * self.ahead

    def point(self, s: Array, lateral: Array | float) -> Array:
        """Points (…, 3) on the road's surface at arc lengths ``s``, ``lateral`` metres to the right of the axis."""
        x, y, _ = self.axis.frame(s - self.anchor_arc, lateral)
        return np.asarray(self.anchor + x[..., None] * self.ahead - y[..., None] * self.right)

    def coordinates(self, points: Array) -> tuple[Array, Array]:
        """Arc lengths and lateral positions (…) of ``points`` (…, 3) on the road's surface."""
        from_anchor = points - self.anchor
        s, lateral = self.axis.locate(from_anchor @ self.ahead, -from_anchor @ self.right)
        return self.anchor_arc + s, lateral


@dataclass(frozen=True, eq=False)
class Pose:
    """A vehicle's main plane: its ``centre`` (3,) and the ``axes`` (3, 3) right and down as seen, and away."""

    centre: Array
    axes: Array

    def corners(self, width: float, height: float) -> Array:
        """World corners (4, 3) top-left, top-right, bottom-right, bottom-left as seen."""
        x, y = width / 2, height / 2
        return np.asarray(self.centre + np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]) @ self.axes.T)


class Motion:
    """Where a vehicle is at any time from ``margin`` s before 0 to as long after ``duration`` s: its centre moves along
    its own path with exactly its own speed."""

    def __init__(self, road: PlacedRoad, vehicle: Vehicle, duration: float, margin: float = 0.1) -> None:
        self.road, self.vehicle = road, vehicle
        self.direction = 1.0 if vehicle.receding else -1.0
        travelled = self.travelled(np.linspace(-margin, duration + margin, 2001))
        if np.any(np.diff(travelled) <= 0):
            raise ValueError(f"vehicle {vehicle.id} does not move forward throughout the clip")
        u = np.linspace(travelled[0], travelled[-1], 4001)
        heading = np.full_like(u, vehicle.heading_error)
        if vehicle.lane_change is not None:
            heading += np.arcsin(vehicle.lane_change.slope_at(u))
        start = vehicle.lane + vehicle.lateral
        drift = _integrate(np.sin(heading), u)
        lateral = start + self.direction * (drift - np.interp(0.0, u, drift))
        arc = _integrate(np.cos(heading) / (1 - road.axis.curvature(0.0) * lateral), u)
        arc = vehicle.start_distance + self.direction * (arc - CubicSpline(u, arc)(0.0))
        self._path = CubicSpline(u, np.column_stack([arc, lateral, heading]))

    def travelled(self, t: Array) -> Array:
        return np.asarray(self.vehicle.speed * t + self.vehicle.acceleration * self._changing(t) ** 2 / 2)

    def speed(self, t: float) -> float:
        return float(self.vehicle.speed + self.vehicle.acceleration * self._changing(np.array(t)))

    def _changing(self, t: Array) -> Array:
        """For how long the speed has been changing at times ``t``."""
        return np.maximum(t - self.vehicle.acceleration_start, 0.0) if self.vehicle.acceleration_start else t

    def pose(self, t: float) -> Pose:
        """The main plane at time ``t`` s: a front perpendicular to the direction of travel, a side parallel to it."""
        s, lateral, heading = self._path(self.travelled(np.array(t)))
        along, right = (self.direction * v for v in self.road.frame(np.asarray(s)))
        down = self.road.down
        height = PLANE_CLEARANCE_M + self.vehicle.height / 2
        centre = self.road.point(np.asarray(s), lateral) - height * down
        travel = np.cos(heading) * along + np.sin(heading) * right
        normal = travel if self.vehicle.plane == "front" else np.cross(down, travel)
        if normal @ centre < 0:
            normal = -normal
        return Pose(centre, np.column_stack([np.cross(down, normal), down, normal]))


def _integrate(f: Array, u: Array) -> Array:
    return np.asarray(cumulative_simpson(f, x=u, initial=0.0))


def make_rig(scene: Scene) -> StereoRig:
    """The scene's rig as calibrated, slightly out of true in every respect."""
    rng = np.random.default_rng([scene.seed, 3])
    w, h = scene.image_size

    def camera() -> Camera:
        fx = scene.focal * (1 + rng.normal(0, 0.002))
        cx, cy = (w - 1) / 2 + rng.normal(0, 4), (h - 1) / 2 + rng.normal(0, 4)
        K = np.array([[fx, 0, cx], [0, fx * (1 + rng.normal(0, 2e-4)), cy], [0, 0, 1.0]])
        return Camera(scene.image_size, K, readout=Quantity(0.0))

    left, right = camera(), camera()
    angles = np.clip(rng.normal(0, scene.rotation_sigma, 3), -0.02, 0.02)
    R = np.asarray(cv2.Rodrigues(angles)[0], float)
    t = -np.array([scene.baseline, *rng.normal(0, 0.004, 2)])
    return StereoRig(left, right, R, t)


def rig_views(rig: StereoRig) -> tuple[PosedCamera, PosedCamera]:
    """The rig's left and right view."""
    return PosedCamera(rig.left, np.eye(3), np.zeros(3)), PosedCamera(rig.right, rig.R, rig.t)


def visible_line(
    scene: Scene,
    road: PlacedRoad,
    lane: float,
    positions: Array,
    view: PosedCamera,
    project: Callable[[Array], Array] | None = None,
) -> Array:
    """Pixels (N, 2), closely along the line beside a lane, inside the image and near the ``positions``
    (M, 3): up to 60 m nearer to the camera and 6 m farther. ``project`` gives the pixels (K, 2) of points (K, 3) where
    these are not those of ``view``."""
    if len(positions) == 0:
        return np.empty((0, 2))
    driven = road.coordinates(positions)[0]
    s = np.linspace(driven.min() - 60, driven.max() + 6, 4000)
    points = road.point(s, np.full_like(s, lane + scene.line_offset))
    pixels = (project or view.project)(points[view.depth(points) > 2])
    is_visible = ((pixels > 6) & (pixels < np.array(scene.image_size) - 7)).all(1)
    return longest_visible_run(pixels, np.asarray(is_visible))  # a curve may leave the image and come back
