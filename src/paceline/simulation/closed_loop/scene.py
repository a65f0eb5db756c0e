"""The scene of a closed loop: the world and its road, the motion of the lead and of vehicles that cut in."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import repeat
from typing import Any

import numpy as np

from paceline.recordings.odometry import Pose
from paceline.simulation.chase.motion import CameraShake, RoadPose, SmoothNoise, road_pose, winding_road
from paceline.simulation.chase.projection import CameraPose, camera_rotation
from paceline.simulation.chase.scene import ChaseScene, Occlusion
from paceline.simulation.chase.scenery import LANE_WIDTH_M
from paceline.simulation.chase.vehicles import Body, make_vehicle
from paceline.simulation.chase.world import ChaseWorld, WorldState
from paceline.simulation.closed_loop.drive_yaml import CutInModel, DriveModel
from paceline.simulation.closed_loop.gap_control import GapPolicy
from paceline.simulation.closed_loop.lead_vehicle import LeadVehicle, road_from_pieces
from paceline.simulation.closed_loop.vehicle_dynamics import VehicleParameters, point_ahead
from paceline.simulation.closed_loop.vehicle_dynamics import VehicleState as Chase
from paceline.simulation.lane_change import smoothstep
from paceline.simulation.random_scenes.drawn import random_chase
from paceline.simulation.road import PolygonalAxis
from paceline.simulation.vehicle_catalogue import MIN_RASTERIZED_GAP_M

DRIVE_START_ARC_M = 30.0  # m along the road at which the camera begins
ROAD_BEYOND_END_M = 400.0  # m of road that are laid out beyond the end of the drive
OVERTAKING_SPEED_MPS = 3.0  # m/s by which a vehicle that cuts in is faster before and after
FULL_SHAKE_SPEED_MPS = 5.0  # m/s, from which the road shakes the vehicle in full
GAP_POLICIES = {
    "nist": GapPolicy(),
    "hd": GapPolicy(headway=1.2, top_speed=31.0, throttle=1.6, correction=0.3, reaction=0.45),
}


class DriveScene:
    """Everything but the chase vehicle's motion, for the scene ``model`` with a ``seed``."""

    def __init__(self, model: DriveModel, seed: int, chase: VehicleParameters) -> None:
        self.model, self.vehicle = model, chase
        self.chase_scene = _draw_chase_scene(model, seed)
        self.policy = gap_policy(model, self.chase_scene)
        rng = np.random.default_rng([seed, 73])
        fastest = max(v for _, v in model.lead.speed)
        first = DRIVE_START_ARC_M + self.policy.desired_gap(model.lead.speed[0][1])
        self.road = _make_road(
            model, first + fastest * model.duration + ROAD_BEYOND_END_M, np.random.default_rng([seed, 61])
        )
        self.lead = LeadVehicle(
            self.road,
            first,
            model.duration,
            np.array(model.lead.speed),
            model.lead.lane_changes,
            model.lead.weaves,
            model.lead.max_acceleration,
            model.lead.max_lateral_acceleration,
        )
        shake = self.chase_scene.shake_px
        self._pitch_shake, self._yaw_shake = (CameraShake(rng, a * shake / 300) for a in (2.4, 0.25))
        self._roll_shake, self._heave_shake = CameraShake(rng, 0.004 * shake / 4), CameraShake(rng, 0.02 * shake / 4)
        self._lead_roll, self._lead_lift = SmoothNoise(rng, 0.8, 4.0), SmoothNoise(rng, 0.5, 3.0)
        other_vehicles = tuple(_make_cut_in_body(rng, c) for c in model.cut_ins)
        about = partial(_expected_arc, self.lead, self.policy.standstill)
        self.world = ChaseWorld(self.chase_scene, self.road, DRIVE_START_ARC_M, about, rng, other_vehicles)

    def start(self) -> Chase:
        """The chase vehicle on the lead's path, at the lead's speed and the policy's distance."""
        p = road_pose(self.road, DRIVE_START_ARC_M - self.vehicle.camera_ahead, 0.0, 0.0)
        return Chase(p.x, p.y, p.heading, self.lead.speed_at(0.0))

    def pose(self, time: float, chase: Chase) -> Pose:
        """The camera in plan, shaken as the body is."""
        x, y = point_ahead(chase, self.vehicle.camera_ahead)
        return Pose(float(x), float(y), chase.heading + self._shake_share(chase) * self._yaw_shake(time))

    def state_at(self, time: float, chase: Chase, near: float) -> WorldState:
        """The world at ``time``, s, with the chase vehicle at ``chase``, its camera about ``near`` m along the road."""
        scene, rough, pose = self.chase_scene, self._shake_share(chase), self.pose(time, chase)
        arc, lateral = map(float, self.road.locate(pose.x, pose.y, near))
        camera = CameraPose(
            scene.camera.K,
            camera_rotation(
                scene.tilt + chase.pitch + rough * self._pitch_shake(time), chase.roll + rough * self._roll_shake(time)
            ),
            scene.camera_height + rough * self._heave_shake(time),
            pose.x,
            pose.y,
            pose.heading,
        )
        turning = rough * self._yaw_shake.rate(time) + self._yaw_rate(chase)
        nodding = rough * self._pitch_shake.rate(time) + chase.pitch_rate
        model, vanishes = self.model, self.model.lead.vanishes
        return self.world.state_at(
            time,
            camera,
            RoadPose(arc, lateral, pose.x, pose.y, pose.heading),
            self.lead.pose_at(time),
            lead_roll=0.008 * self._lead_roll(time),
            lead_lift=0.015 * self._lead_lift(time),
            image_motion=(turning, nodding),
            braking=self.lead.acceleration_at(time) < -0.5 or self.lead.speed_at(time) < 0.1,
            lead_present=vanishes is None or time < vanishes,
            other_vehicles=tuple(map(self._cut_in_pose, model.cut_ins, self.world.other_vehicles, repeat(time))),
        )

    def _shake_share(self, chase: Chase) -> float:
        return min(chase.speed / FULL_SHAKE_SPEED_MPS, 1.0)

    def _yaw_rate(self, chase: Chase) -> float:
        v = self.vehicle
        return float(-chase.speed * np.tan(chase.steering) / (v.wheelbase + v.understeer * chase.speed**2))

    def _cut_in_pose(self, c: CutInModel, body: Body, time: float) -> RoadPose:
        """A vehicle that comes up in the other lane, changes in behind the lead and out again."""

        def where(t: float) -> tuple[float, float]:
            extra_distance = OVERTAKING_SPEED_MPS * (min(t - c.at, 0.0) + max(t - c.until - c.duration, 0.0))
            arc = self._lead_arc(t) - c.behind - body.length + extra_distance
            inside = float(smoothstep((t - c.at) / c.duration) - smoothstep((t - c.until) / c.duration))
            return arc, LANE_WIDTH_M * (inside - 1)

        (before, left), (after, right) = where(time - 0.01), where(time + 0.01)
        arc, lateral = where(time)
        return road_pose(self.road, arc, lateral, (right - left) / max(after - before, 1e-3))

    def _lead_arc(self, time: float) -> float:
        """The lead's, carried on before the start and after the end at the speed there."""
        within = min(max(time, 0.0), float(self.lead.time[-1]))
        return self.lead.arc_at(within) + (time - within) * self.lead.speed_at(within)


def _expected_arc(lead: LeadVehicle, metres: float, time: float) -> float:
    """About where the chase vehicle is at ``time``, s: m along the road."""
    return lead.arc_at(time) - metres


def gap_policy(model: DriveModel, scene: ChaseScene) -> GapPolicy:
    """How to keep the distance: never so near that the whole rear does not fit into the picture."""
    policy = GAP_POLICIES[model.camera]
    near = 8.0 if model.camera == "hd" else MIN_RASTERIZED_GAP_M[scene.kind] + 0.5
    return replace(policy, standstill=near, headway=model.headway or policy.headway)


def _draw_chase_scene(model: DriveModel, seed: int) -> ChaseScene:
    settings: dict[str, Any] = model.appearance.model_dump(exclude_none=True)
    if model.lead.kind is not None:
        settings["kind"] = model.lead.kind
    settings["occlusions"] = tuple(Occlusion(c.at, c.duration, c.kind) for c in model.crossings)
    rate = 15.0
    return random_chase(seed, model.camera, frames=round(model.duration * rate), **(settings | {"rate": rate}))


def _make_road(model: DriveModel, length: float, rng: np.random.Generator) -> PolygonalAxis:
    if model.road.radius is not None:
        return winding_road(rng, length, model.road.radius)
    pieces = [(metres, 1 / radius if radius else 0.0) for metres, radius in model.road.pieces or []]
    return road_from_pieces(pieces, length, model.road.blend)


def _make_cut_in_body(rng: np.random.Generator, c: CutInModel) -> Body:
    return make_vehicle(rng, c.kind, float(rng.choice([35.0, 60.0, 120.0, 190.0])))
