"""The world of a chase: all objects placed along the road, and its state for given poses of the two vehicles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from paceline.arrays import Array
from paceline.simulation.chase.motion import RoadPose, road_pose
from paceline.simulation.chase.projection import (
    CameraPose,
    Faces,
    Sun,
    TextureAtlas,
    join_faces,
    move_faces,
    place_faces,
)
from paceline.simulation.chase.scene import ChaseScene, Occlusion
from paceline.simulation.chase.scenery import (
    LANE_WIDTH_M,
    RoadsideObject,
    oncoming_faces,
    place_roadside,
    stand_on_ground,
    upright_face,
)
from paceline.simulation.chase.vehicles import AntialiasedCanvas, Body, Face, make_vehicle
from paceline.simulation.road import PolygonalAxis

CROSSING_VEHICLE_LENGTH_M = 3.2


@dataclass(frozen=True, eq=False)
class WorldState:
    """The world at one time: the poses of camera and vehicles, the corners (4, 2) px of the lead's rear plane."""

    time: float
    camera: CameraPose
    chase: RoadPose
    lead: RoadPose
    lead_roll: float
    lead_lift: float  # m
    gap: float  # m ahead of the camera's foot, level
    position: Array  # (3,) m, camera axes
    corners: Array
    image_motion: tuple[float, float]  # rad/s, of the image to the right and down
    braking: bool
    lead_present: bool  # False: the lead has vanished
    other_vehicles: tuple[RoadPose, ...]  # in the order of the world's ``other_vehicles``


class ChaseWorld:
    """A scene with all objects placed along its ``road``; `state_at` gives its state for the poses of the vehicles.

    ``arc`` is the approximate arc length (m) of the chase vehicle at a time, at which oncoming traffic meets it;
    ``start`` is its first arc length, m. Random numbers come from ``rng``.
    """

    def __init__(
        self,
        scene: ChaseScene,
        road: PolygonalAxis,
        start: float,
        arc: Callable[[float], float],
        rng: np.random.Generator,
        other_vehicles: tuple[Body, ...] = (),
    ) -> None:
        self.scene, self.road, self._arc = scene, road, arc
        azimuth = float(road.frame(start)[2]) + scene.sun_azimuth
        self.sun = Sun(azimuth, scene.sun_elevation, scene.ambient)
        self.atlas = TextureAtlas()
        self.body, self.other_vehicles = lead_body(scene), other_vehicles
        self._lead = self._faces(self.body.faces + self.body.lamps)
        self._place_things(place_roadside(scene.seed, road.length - 30, scene.object_density, scene.parallel_share))
        self._oncoming = [self._faces(oncoming_faces(rng)) for _ in range(3)]
        self.oncoming_schedule = float(rng.uniform(5, 12)), rng.uniform(0.2, 0.8, 64)
        self._crossing = [self._faces(_make_crossing_faces(rng, o, scene)) for o in scene.occlusions]
        self._companions = [
            self._faces(stand_on_ground(b.faces + b.lamps, b.clearance + b.height / 2)) for b in other_vehicles
        ]
        self.atlas.pack()

    def _faces(self, faces: tuple[Face, ...]) -> Faces:
        return place_faces(faces, self.atlas, self.road, RoadPose(0.0, 0.0, 0.0, 0.0, 0.0))

    def _place_things(self, things: list[RoadsideObject]) -> None:
        placed = [self._faces(())]
        for thing in things:
            x, y, heading = self.road.frame(thing.arc, thing.lateral)
            pose = RoadPose(thing.arc, thing.lateral, float(x), float(y), float(heading) + thing.turn)
            placed.append(place_faces(thing.faces, self.atlas, self.road, pose))
        self._roadside = join_faces(placed)

    def roadside_faces(self, arc0: float, arc1: float) -> Faces:
        """Faces of the objects beside the road from one arc length to another."""
        first, last = np.searchsorted(self._roadside.arc, (arc0, arc1))
        return self._roadside[int(first) : int(last)]

    def moving_faces(self, state: WorldState) -> list[Faces]:
        """Faces of oncoming traffic, of objects that cross before the lead, and of the other vehicles."""
        groups = []
        if self.scene.traffic:
            every, part = self.oncoming_schedule
            for k in range(int(state.time / every), int(state.time / every) + 2):
                meeting_time = (k + part[k % len(part)]) * every
                arc = self._arc(meeting_time) + self.scene.top_speed * (meeting_time - state.time)
                if state.chase.arc < arc < min(state.chase.arc + 150, self.road.s[-1]):
                    pose = road_pose(self.road, arc, -LANE_WIDTH_M, 0.0)
                    groups.append(move_faces(self._oncoming[k % len(self._oncoming)], self.road, pose))
        for occlusion, faces in zip(self.scene.occlusions, self._crossing, strict=True):
            if abs(state.time - occlusion.time) < 4 * occlusion.duration:
                groups.append(move_faces(faces, self.road, self._crossing_state(state, occlusion)))
        for faces, pose in zip(self._companions, state.other_vehicles, strict=True):
            groups.append(move_faces(faces, self.road, pose))
        return groups

    def _crossing_state(self, state: WorldState, occlusion: Occlusion) -> RoadPose:
        """The pose of a crossing object: about half-way to the lead, at a constant speed across its middle."""
        ahead = 0.55 * state.gap
        across, _ = state.camera.to_level(state.lead.x, state.lead.y)
        long = CROSSING_VEHICLE_LENGTH_M if occlusion.kind == "vehicle" else 0.3
        speed = (long + 0.55 * self.body.width) / occlusion.duration
        right = 0.55 * float(across) + speed * (state.time - occlusion.time)
        c, s = np.cos(state.camera.heading), np.sin(state.camera.heading)
        x, y = state.camera.x + ahead * c + right * s, state.camera.y + ahead * s - right * c
        return RoadPose(state.chase.arc + ahead, right, float(x), float(y), state.camera.heading)

    def state_at(
        self,
        time: float,
        camera: CameraPose,
        chase: RoadPose,
        lead: RoadPose,
        *,
        lead_roll: float = 0.0,
        lead_lift: float = 0.0,
        image_motion: tuple[float, float] = (0.0, 0.0),
        braking: bool = False,
        lead_present: bool = True,
        other_vehicles: tuple[RoadPose, ...] = (),
    ) -> WorldState:
        """The state of the world at ``time``, s, for given poses of the camera and the vehicles."""
        plane = self._plane(camera, lead, lead_roll, lead_lift)
        corners = self.scene.camera.project(plane[1:])
        ahead = float(camera.to_level(lead.x, lead.y)[1])
        return WorldState(
            time,
            camera,
            chase,
            lead,
            lead_roll,
            lead_lift,
            ahead,
            plane[0],
            corners,
            image_motion,
            braking,
            lead_present,
            other_vehicles,
        )

    def _plane(self, camera: CameraPose, lead: RoadPose, roll: float, lift: float) -> Array:
        """Centre and corners (5, 3) of the lead's rear plane in camera axes."""
        x, y = self.body.width / 2, self.body.height / 2
        flat = np.array([[0, 0], [-x, -y], [x, -y], [x, y], [-x, y]])
        c, s = np.cos(roll), np.sin(roll)
        right, down = flat[:, 0] * c - flat[:, 1] * s, flat[:, 0] * s + flat[:, 1] * c
        turn = lead.heading - camera.heading
        r0, a0 = camera.to_level(lead.x, lead.y)
        height = self.body.clearance + y + lift
        level = np.column_stack([r0 + right * np.cos(turn), down - height, a0 + right * np.sin(turn)])
        return camera.to_camera(level)

    def lead_faces(self, state: WorldState) -> Faces:
        """The lead's faces, lamps last, about the foot of its rear plane."""
        c, s = np.cos(state.lead_roll), np.sin(state.lead_roll)
        roll = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        lift = np.array([0, self.body.clearance + self.body.height / 2 + state.lead_lift, 0])
        f = self._lead
        rolled = replace(f, corner=f.corner @ roll.T - lift, across=f.across @ roll.T, down=f.down @ roll.T)
        return move_faces(rolled, self.road, state.lead)

    def shadow_outlines(self, state: WorldState) -> tuple[Array, Array]:
        """Outlines (2 V, E, 3) of the shadow in the sun and of the contact shadow under each of V vehicles; see
        `rasterizer.ground`."""
        vehicles = [(self.body, state.lead)] if state.lead_present else []
        vehicles += zip(self.other_vehicles, state.other_vehicles, strict=True)
        outlines = [edges for body, pose in vehicles for edges in self._shadow_outline(state.camera, body, pose)]
        occlusion = [(0.0, 0.05), (0.8, 0.35)] * len(vehicles)
        return np.array(outlines).reshape(-1, 8, 3), np.array(occlusion).reshape(-1, 2)

    def _shadow_outline(self, camera: CameraPose, body: Body, pose: RoadPose) -> tuple[Array, Array]:
        half, length = body.width / 2, body.length
        turn = pose.heading - camera.heading
        box = np.array([[-half, 0], [half, 0], [half, length], [-half, length]])
        c, s = np.cos(turn), np.sin(turn)
        r0, a0 = camera.to_level(pose.x, pose.y)
        foot = np.column_stack([a0 + box[:, 0] * s + box[:, 1] * c, r0 + box[:, 0] * c - box[:, 1] * s])
        towards = self.sun.direction(camera.heading)
        roof_height = body.clearance + body.height / 2 + body.top
        roof = foot + roof_height * towards[[2, 0]] / towards[1]
        return _outline_edges(np.vstack([foot, roof])), _outline_edges(foot)


def lead_body(scene: ChaseScene) -> Body:
    """The body of the lead."""
    return make_vehicle(np.random.default_rng([scene.seed, 37]), scene.kind, scene.paint)


def _make_crossing_faces(rng: np.random.Generator, occlusion: Occlusion, scene: ChaseScene) -> tuple[Face, ...]:
    if occlusion.kind == "post":
        return (upright_face(AntialiasedCanvas(0.3, 4.0, rng.uniform(30, 160), density=60).finish(), 0.3, 4.0),)
    c = AntialiasedCanvas(CROSSING_VEHICLE_LENGTH_M, 1.5, rng.uniform(30, 190), density=120)
    c.mottle(rng, 0.05, 0.4)
    for x in (0.5, 1.7):
        c.box(x, 0.15, 1.05, 0.5, 30)
    c.box(0, 1.25, CROSSING_VEHICLE_LENGTH_M, 0.25, 15)
    return (upright_face(c.finish(), CROSSING_VEHICLE_LENGTH_M, scene.camera_height * 0.5 + 1.2, foot=0.15),)


def _outline_edges(points: Array) -> Array:
    """The edges (8, 3) of the convex outline of up to 8 ``points`` (N, 2), the last one repeated: (a, b, c) so that
    a x + b y + c is the distance from it, positive inside."""
    hull = cv2.convexHull(points.astype(np.float32), clockwise=True).reshape(-1, 2).astype(float)
    along = np.roll(hull, -1, axis=0) - hull
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
    normal *= np.sign(((hull.mean(0) - hull) * normal).sum(1, keepdims=True))
    edges = np.column_stack([normal, -(normal * hull).sum(1)])
    return np.vstack([edges, np.repeat(edges[-1:], 8 - len(edges), axis=0)])
