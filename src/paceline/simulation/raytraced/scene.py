"""A speed scene with all objects placed: road, vehicles, cameras, light, and the exact truth about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from paceline.arrays import Array
from paceline.cameras import Camera, PosedCamera, Quantity, RigUncertainty, StereoRig
from paceline.documents.assumed_calibration import with_assumed_uncertainty
from paceline.errors import UnusableInput
from paceline.simulation.camera_errors import MovingViews, StereoErrors
from paceline.simulation.operator import MIN_OUTLINE_WIDTH_PX, is_inside_image, never_outlined, outline_width
from paceline.simulation.raytraced import road_surface
from paceline.simulation.raytraced.light import Light
from paceline.simulation.raytraced.meshes import Placement, SceneMesh
from paceline.simulation.raytraced.motion import DrivingPlan, VehicleMotion
from paceline.simulation.raytraced.renderer import Renderer
from paceline.simulation.raytraced.scene_yaml import PositionModel, SceneModel, SpeedScene, VehicleModel
from paceline.simulation.raytraced.scenery.placement import Scenery, build_scenery
from paceline.simulation.raytraced.sensor import Sensor, Shutter
from paceline.simulation.raytraced.vehicles.build import Body, Plane, build
from paceline.simulation.road import Road, RoadShape

OFF_SCENE: Placement = (
    np.eye(3),
    np.array([0.0, 0.0, -1e4]),
)  # below the ground, for a vehicle that is not on the road
MAX_RELIEF_M = 0.6  # m that a vehicle's own surfaces may lie before its plane
MIN_TRUTH_DEPTH_M = 1.0  # of a plane whose place in the images is in truth.json
VISIBILITY_GRID = 9, 15  # rows and columns of the points by which the visible share of a plane is estimated


@dataclass(frozen=True, eq=False)
class PlacedVehicle:
    """A vehicle of a scene: its body, its motion, and the plane of it that the cameras see."""

    model: VehicleModel
    body: Body
    motion: VehicleMotion
    plane: Plane

    def center(self, t: float) -> Array:
        """The plane's centre (3,) in the world at ``t`` s."""
        R, origin = self.motion.pose(t)
        return np.asarray(R @ self.plane.center + origin)

    def corners(self, t: float) -> Array:
        """The plane's corners (4, 3) in the world at ``t`` s."""
        R, origin = self.motion.pose(t)
        return np.asarray(self.plane.corners() @ R.T + origin)

    def speed(self, t: float) -> float:
        """Speed of the plane's centre, m/s: in a bend it is not that of the rear axle."""
        return float(np.linalg.norm(self.center(t + 1e-3) - self.center(t - 1e-3)) / 2e-3)

    def is_there(self, t: float) -> bool:
        first, last = self.motion.span
        return first + 0.01 < t < last - 0.01

    def placements(self, t: float) -> list[Placement]:
        """Of the body and of each wheel at ``t`` s."""
        if not self.is_there(t):
            return [OFF_SCENE] * (1 + len(self.body.wheels))
        return place_body(self.body, self.motion.pose(t), self.motion.distance(t))


def rigid_groups(body: Body) -> list[Sequence[SceneMesh]]:
    """What of ``body`` moves as one: the body and each wheel."""
    return [body.meshes, *((wheel.mesh,) for wheel in body.wheels)]


def place_body(body: Body, pose: Placement, rolled: float) -> list[Placement]:
    """Placements of `rigid_groups` where the body stands at ``pose`` and has driven ``distance`` metres."""
    R, origin = pose
    placements = [(R, origin)]
    for wheel in body.wheels:
        c, s = np.cos(rolled / wheel.radius), np.sin(rolled / wheel.radius)
        turned = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])  # the top goes forward
        placements.append((R @ turned, R @ wheel.center + origin))
    return placements


class PlacedStereoScene:
    """A speed scene with everything placed. ``rig`` is the true one, ``written_rig`` that of rig.yaml; ``views`` are
    the true cameras in the world at rest and ``moving`` the same as they move; ``clocks`` (2, F) s are the stated times
    of the left and the right images and ``times`` (2, F) s the true ones.

    Raises UnusableInput where the scene contradicts itself.
    """

    def __init__(self, scene: SpeedScene) -> None:
        self.scene, self.road, self.light = scene, make_road(scene), make_light(scene)
        calibrated, self.written_rig = make_rigs(scene)
        self.errors = make_errors(scene)
        self.rig = self.errors.true_rig(calibrated)
        left = look_at(self.rig.left, self._place(scene.rig.eye), self._place(scene.rig.target))
        right = PosedCamera(self.rig.right, self.rig.R @ left.R, self.rig.R @ left.t + self.rig.t)
        self.views = left, right
        ticks = np.array([k for k in range(scene.frames) if k not in scene.dropped]) / scene.rate
        if len(ticks) == 0:
            raise UnusableInput("dropped: no frame is left")
        self.clocks = np.stack([ticks, ticks + scene.skew])
        self.times = np.stack(self.errors.exposure_times((self.clocks[0], self.clocks[1])))
        self.moving = MovingViews(self.views, self.errors, scene.rate, scene.seed)
        self.vehicles = [self._car(i, model) for i, model in enumerate(scene.vehicles)]
        self.shutters = tuple(replace(make_shutter(scene), readout=e.readout) for e in self.errors.cameras)

    def first_pixels(self, i: int, points: Array) -> Array:
        """Ideal pixels (N, 2) at which the first picture of view ``i`` shows ``points`` (N, 3) that stand still."""
        return self.moving.project(i, float(self.times[i, 0]), lambda _: points)

    def _place(self, place: PositionModel) -> Array:
        position, axes = self.road.frame(place.along, place.right)
        return np.asarray(position + place.height * np.array([0.0, 0.0, 1.0]))

    def _car(self, i: int, m: VehicleModel) -> PlacedVehicle:
        drive = DrivingPlan(
            m.start,
            m.speed,
            self.road.lanes[m.lane] + m.offset,
            m.acceleration,
            m.acceleration_start,
            np.inf if m.acceleration_duration is None else m.acceleration_duration,
            oncoming=m.oncoming,
        )
        if m.lane_change:
            drive = drive.with_lane_change(m.lane_change.start, m.lane_change.duration, m.lane_change.shift)
        body = build(m.kind, m.seed)
        try:
            motion = VehicleMotion(self.road, drive, body.wheelbase)
        except UnusableInput as error:
            raise UnusableInput(f"vehicles[{i}]: {error}") from None
        front, rear = (PlacedVehicle(m, body, motion, plane) for plane in (body.front, body.rear))
        first = {end: self._first_outlined_frame(car) for end, car in (("front", front), ("rear", rear))}
        if first["front"] == first["rear"]:  # neither is ever in view
            return front if self._approaches(motion) else rear
        return front if first["front"] < first["rear"] else rear

    def _first_outlined_frame(self, car: PlacedVehicle) -> float:
        """The first frame in which a vehicle's plane faces the left camera and could be outlined, were nothing in
        front of it; infinite where there is none."""
        view, size = self.views[0], self.rig.left.image_size
        for k, times in enumerate(self.times.T.tolist()):
            if not car.is_there(times[0]):
                continue
            outwards = car.motion.pose(times[0])[0][:, 0] * (1.0 if car.plane.end == "front" else -1.0)
            if outwards @ (view.centre - car.center(times[0])) <= 0 or not self._is_before_cameras(
                car.corners(times[0])
            ):
                continue
            pixels = [self.project_plane(i, car, t) for i, t in enumerate(times)]
            if all(is_inside_image(p, size) for p in pixels) and outline_width(pixels) >= MIN_OUTLINE_WIDTH_PX:
                return k
        return np.inf

    def check_outlines(self) -> None:
        """Raises UnusableInput for a measured vehicle that could never be outlined, even if nothing hid it."""
        for car in self.vehicles:
            if car.model.measured and self._first_outlined_frame(car) == np.inf:
                raise never_outlined(car)

    def _is_before_cameras(self, corners: Array) -> bool:
        """Whether ``corners`` (4, 3) in the world are all at least MIN_TRUTH_DEPTH_M before both cameras."""
        return min(float(view.to_camera(corners)[:, 2].min()) for view in self.views) >= MIN_TRUTH_DEPTH_M

    def _approaches(self, motion: VehicleMotion) -> bool:
        """Whether the left camera sees a vehicle from ahead where it is farthest before it: one that overtakes it
        begins behind it."""
        view = self.views[0]
        poses = [motion.pose(t) for t in self.times[0].tolist() if motion.span[0] < t < motion.span[1]]
        R, origin = max(poses, key=lambda pose: float(view.to_camera(pose[1])[2]), default=motion.pose(0.0))
        return bool((view.centre - origin) @ R[:, 0] > 0)

    def static_meshes(self) -> list[SceneMesh]:
        """All that does not move."""
        rig = self.scene.rig
        clear = ((rig.eye.along, rig.eye.right, 4.0), *self._line_of_sight_circles())
        spec = Scenery(**self.scene.scenery.model_dump(), seed=self.scene.seed, clear=clear)
        return road_surface.road_meshes(self.road) + build_scenery(self.road, spec, 0.0, self.road.length)

    def _line_of_sight_circles(self) -> list[tuple[float, float, float]]:
        """Circles along the line of sight, so that no tree hides what the rig was put up for."""
        eye, target = self.scene.rig.eye, self.scene.rig.target
        share = np.linspace(0.0, 1.0, 20)[1:]
        along, right = eye.along + share * (target.along - eye.along), eye.right + share * (target.right - eye.right)
        return [(float(a), float(r), 2.5) for a, r in zip(along, right, strict=True)]

    def moving_groups(self) -> list[Sequence[SceneMesh]]:
        return [part for car in self.vehicles for part in rigid_groups(car.body)]

    def placements(self, t: float) -> list[Placement]:
        return [p for car in self.vehicles for p in car.placements(t)]

    def empty_placements(self) -> list[Placement]:
        """Placements without any vehicle."""
        return [OFF_SCENE] * sum(1 + len(car.body.wheels) for car in self.vehicles)

    def truth(self, renderer: Renderer) -> list[dict[str, Any]]:
        """One row for every vehicle and frame in which it is before both cameras."""
        rows: dict[str, list[dict[str, Any]]] = {car.model.id: [] for car in self.vehicles}
        for k, times in enumerate(self.times.T.tolist()):
            renderer.place(self.placements(times[0]))
            for car in self.vehicles:
                if car.is_there(times[0]) and (row := self._row(car, k, times, renderer)):
                    rows[car.model.id].append(row)
        return [row for own in rows.values() for row in own]

    def _row(self, car: PlacedVehicle, k: int, times: list[float], renderer: Renderer) -> dict[str, Any] | None:
        """The row of one vehicle in a frame whose left picture the world is placed for."""
        corners = car.corners(times[0])
        if not self._is_before_cameras(corners):
            return None
        left, right = (self.project_plane(i, car, t) for i, t in enumerate(times))
        size = self.rig.left.image_size
        center = car.center(times[0])
        return {
            "frame": k,
            "time_s": times[0],
            "vehicle": car.model.id,
            "speed_mps": car.speed(times[0]),
            "position": self.views[0].to_camera(center).tolist(),
            "left": left.tolist(),
            "right": right.tolist(),
            "inside": is_inside_image(left, size) and is_inside_image(right, size),
            "visible": min(visible_share(renderer, view.centre, corners) for view in self.views),
            "distance_m": float(np.linalg.norm(center - self.views[0].centre)),
            "corners": self.views[0].to_camera(corners).tolist(),
            "axle_speed_mps": car.motion.speed(times[0]),
        }

    def project_plane(self, i: int, car: PlacedVehicle, t: float) -> Array:
        """Ideal pixels (4, 2) of a vehicle's plane in the frame of time ``t`` s of view ``i``, each at the time its row
        is read."""
        return self.moving.project(i, t, car.corners)


def make_road(scene: SceneModel) -> Road:
    shape = scene.road.model_dump(exclude={"length"})
    return Road(RoadShape(**shape), scene.road.length, scene.seed)


def make_light(scene: SceneModel) -> Light:
    return Light(scene.light.azimuth, scene.light.elevation, scene.light.clouds, scene.seed)


def make_sensor(scene: SceneModel) -> Sensor:
    s = scene.sensor
    return Sensor(s.exposure, s.full_well, s.read_noise, s.vignetting, s.gamma, s.color, s.blur_sigma)


def make_shutter(scene: SceneModel) -> Shutter:
    s = scene.sensor
    return Shutter(s.shutter_s, s.steps, s.readout, s.bands)


def make_errors(scene: SpeedScene) -> StereoErrors:
    return scene.camera_errors.errors(scene.sensor.readout)


def look_at(camera: Camera, eye: Array, target: Array) -> PosedCamera:
    """A level camera at ``eye`` (3,) whose axis goes through ``target`` (3,), world."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    R = np.array([x, np.cross(z, x), z])
    return PosedCamera(camera, R, -R @ eye)


def visible_share(renderer: Renderer, eye: Array, corners: Array) -> float:
    """How much of the quadrilateral ``corners`` (4, 3) nothing hides from ``eye`` (3,), as the world is placed now."""
    down, across = ((np.arange(n) + 0.5) / n for n in VISIBILITY_GRID)
    v, u = (g.reshape(-1, 1) for g in np.meshgrid(down, across, indexing="ij"))
    points = (1 - v) * ((1 - u) * corners[0] + u * corners[1]) + v * ((1 - u) * corners[3] + u * corners[2])
    hit = renderer.distance(eye, points)
    return float(np.mean(hit > np.linalg.norm(points - eye, axis=1) - MAX_RELIEF_M))


def make_rigs(scene: SpeedScene) -> tuple[StereoRig, StereoRig]:
    """The true rig, slightly out of true, and the one that is written."""
    rig, rng = scene.rig, np.random.default_rng([scene.seed, 3])
    size = (rig.image_size[0], rig.image_size[1])

    def camera() -> Camera:
        fx = rig.focal * (1 + rng.normal(0, 0.002))
        cx, cy = ((n - 1) / 2 + rng.normal(0, 4) for n in size)
        K = np.array([[fx, 0, cx], [0, fx, cy], [0, 0, 1.0]])
        return Camera(size, K, np.array(rig.distortion, float), None if scene.sensor.readout else Quantity(0.0))

    left, right = camera(), camera()
    distance = np.hypot(rig.target.along - rig.eye.along, rig.target.right - rig.eye.right)
    inwards = np.array([0.0, rig.baseline / max(float(distance), 1.0), 0.0])  # both cameras look at the target
    R = np.asarray(cv2.Rodrigues(inwards)[0] @ cv2.Rodrigues(rng.normal(0, 1, 3) * rig.misalignment)[0], float)
    t = -R @ np.array([rig.baseline, *rng.normal(0, 0.004, 2)])
    true = StereoRig(left, right, R, t)
    if rig.rig_error_std is None:
        return true, true if rig.states_uncertainty else with_assumed_uncertainty(true)
    w = rig.rig_error_std
    stated = RigUncertainty(
        w.focal_length_px,
        w.principal_point_px,
        (w.rotation_rad[0], w.rotation_rad[1], w.rotation_rad[2]),
        (w.translation_m[0], w.translation_m[1], w.translation_m[2]),
    )
    turn = np.asarray(cv2.Rodrigues(rng.normal(0, 1, 3) * stated.rotation_rad)[0], float)
    shift = rng.normal(0, 1, 3) * stated.translation_m
    cameras = [_miscalibrate(c, stated, rng) for c in true.cameras]
    written = StereoRig(cameras[0], cameras[1], turn @ R, t + shift, stated)
    return true, written if rig.states_uncertainty else with_assumed_uncertainty(written)


def _miscalibrate(camera: Camera, sigma: RigUncertainty, rng: np.random.Generator) -> Camera:
    K = camera.K.copy()
    K[[0, 1], [0, 1]] += rng.normal(0, 1, 2) * sigma.focal_length_px
    K[:2, 2] += rng.normal(0, 1, 2) * sigma.principal_point_px
    return replace(camera, K=K)
