"""The stage of a closed loop: the world and its road, the lead's plan, who cuts in, and the picture's moment."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import repeat
from typing import Any

import numpy as np

from paceline.recordings.odometry import Pose
from paceline.simulation.chase.motion import Road, Shaking, State, Wander, place, winding
from paceline.simulation.chase.projection import Eye, camera_rotation
from paceline.simulation.chase.scene import ChaseScene, Occlusion
from paceline.simulation.chase.scenery import LANE
from paceline.simulation.chase.vehicles import Body, vehicle
from paceline.simulation.chase.world import ChaseWorld, Moment
from paceline.simulation.closed_loop.drive_yaml import CutInModel, DriveModel
from paceline.simulation.closed_loop.gap_control import GapPolicy
from paceline.simulation.closed_loop.lead_vehicle import LaneChange, Lead, Weave, road_of
from paceline.simulation.closed_loop.vehicle_dynamics import State as Chase
from paceline.simulation.closed_loop.vehicle_dynamics import Vehicle, ahead_of
from paceline.simulation.random_scenes import random_chase
from paceline.simulation.vehicle_catalogue import DRAWN_GAPS

START = 30.0  # m along the road at which the camera begins
VIEW = 400.0  # m of road that are laid out beyond the end of the drive
OVERTAKING = 3.0  # m/s by which a vehicle that cuts in is faster before and after
ROUGH_FROM = 5.0  # m/s, from which the road shakes the vehicle in full
POLICIES = {
    "nist": GapPolicy(),
    "hd": GapPolicy(headway=1.2, top_speed=31.0, throttle=1.6, correction=0.3, reaction=0.45),
}


class Stage:
    """Everything but the chase vehicle's motion, for the scene ``model`` with a ``seed``."""

    def __init__(self, model: DriveModel, seed: int, chase: Vehicle) -> None:
        self.model, self.vehicle = model, chase
        self.scene = _chase_scene(model, seed)
        self.policy = policy_for(model, self.scene)
        rng = np.random.default_rng([seed, 73])
        fastest = max(v for _, v in model.lead.speed)
        first = START + self.policy.wanted(model.lead.speed[0][1])
        self.road = _road(model, first + fastest * model.duration + VIEW, np.random.default_rng([seed, 61]))
        self.lead = Lead(
            self.road,
            first,
            model.duration,
            np.array(model.lead.speed),
            tuple(LaneChange(c.at, c.duration, c.shift) for c in model.lead.lane_changes),
            tuple(Weave(w.start, w.stop, w.amplitude, w.period) for w in model.lead.weaves),
            model.lead.haste,
            model.lead.bends,
        )
        bounce = self.scene.bounce
        self._pitching, self._yawing = (Shaking(rng, a * bounce / 300) for a in (2.4, 0.25))
        self._rolling, self._heaving = Shaking(rng, 0.004 * bounce / 4), Shaking(rng, 0.02 * bounce / 4)
        self._leaning, self._lifting = Wander(rng, 0.8, 4.0), Wander(rng, 0.5, 3.0)
        companions = tuple(_companion(rng, c) for c in model.cut_ins)
        about = partial(_behind, self.lead, self.policy.standstill)
        self.world = ChaseWorld(self.scene, self.road, START, about, rng, companions)

    def start(self) -> Chase:
        """The chase vehicle on the lead's way, at the lead's speed and the policy's distance."""
        p = place(self.road, START - self.vehicle.camera_ahead, 0.0, 0.0)
        return Chase(p.x, p.y, p.heading, self.lead.speed_at(0.0))

    def pose(self, time: float, chase: Chase) -> Pose:
        """The camera in plan, shaken as the body is."""
        x, y = ahead_of(chase, self.vehicle.camera_ahead)
        return Pose(float(x), float(y), chase.heading + self._rough(chase) * self._yawing(time))

    def moment(self, time: float, chase: Chase, near: float) -> Moment:
        """The world at ``time``, s, with the chase vehicle at ``chase``, its camera about ``near`` m along the road."""
        scene, rough, pose = self.scene, self._rough(chase), self.pose(time, chase)
        arc, lateral = self.road.beside(pose.x, pose.y, near)
        eye = Eye(
            scene.camera.K,
            camera_rotation(
                scene.tilt + chase.pitch + rough * self._pitching(time), chase.roll + rough * self._rolling(time)
            ),
            scene.camera_height + rough * self._heaving(time),
            pose.x,
            pose.y,
            pose.heading,
        )
        turning = rough * self._yawing.rate(time) + self._yaw_rate(chase)
        nodding = rough * self._pitching.rate(time) + chase.pitch_rate
        model, vanishes = self.model, self.model.lead.vanishes
        return self.world.moment(
            time,
            eye,
            State(arc, lateral, pose.x, pose.y, pose.heading),
            self.lead.state(time),
            lead_roll=0.008 * self._leaning(time),
            lead_lift=0.015 * self._lifting(time),
            sweep=(turning, nodding),
            braking=self.lead.acceleration_at(time) < -0.5 or self.lead.speed_at(time) < 0.1,
            shown=vanishes is None or time < vanishes,
            companions=tuple(map(self._cutting_in, model.cut_ins, self.world.companions, repeat(time))),
        )

    def _rough(self, chase: Chase) -> float:
        return min(chase.speed / ROUGH_FROM, 1.0)

    def _yaw_rate(self, chase: Chase) -> float:
        v = self.vehicle
        return float(-chase.speed * np.tan(chase.steering) / (v.wheelbase + v.understeer * chase.speed**2))

    def _cutting_in(self, c: CutInModel, body: Body, time: float) -> State:
        """A vehicle that comes up in the other lane, changes in behind the lead and out again."""

        def where(t: float) -> tuple[float, float]:
            beyond = OVERTAKING * (min(t - c.at, 0.0) + max(t - c.until - c.duration, 0.0))
            arc = self._lead_arc(t) - c.behind - body.length + beyond
            inside = smooth((t - c.at) / c.duration) - smooth((t - c.until) / c.duration)
            return arc, LANE * (inside - 1)

        (before, left), (after, right) = where(time - 0.01), where(time + 0.01)
        arc, lateral = where(time)
        return place(self.road, arc, lateral, (right - left) / max(after - before, 1e-3))

    def _lead_arc(self, time: float) -> float:
        """The lead's, carried on before the start and after the end at the speed there."""
        within = min(max(time, 0.0), float(self.lead.time[-1]))
        return self.lead.arc_at(within) + (time - within) * self.lead.speed_at(within)


def _behind(lead: Lead, metres: float, time: float) -> float:
    """About where the chase vehicle is at ``time``, s: m along the road."""
    return lead.arc_at(time) - metres


def smooth(u: float) -> float:
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def policy_for(model: DriveModel, scene: ChaseScene) -> GapPolicy:
    """How to keep the distance: never so near that the whole rear does not fit into the picture."""
    policy = POLICIES[model.camera]
    near = 8.0 if model.camera == "hd" else DRAWN_GAPS[scene.kind] + 0.5
    return replace(policy, standstill=near, headway=model.headway or policy.headway)


def _chase_scene(model: DriveModel, seed: int) -> ChaseScene:
    given: dict[str, Any] = model.look.model_dump(exclude_none=True)
    if model.lead.kind is not None:
        given["kind"] = model.lead.kind
    given["occlusions"] = tuple(Occlusion(c.at, c.duration, c.kind) for c in model.crossings)
    rate = 15.0
    return random_chase(seed, model.camera, frames=round(model.duration * rate), **(given | {"rate": rate}))


def _road(model: DriveModel, length: float, rng: np.random.Generator) -> Road:
    if model.road.radius is not None:
        return winding(rng, length, model.road.radius)
    pieces = [(metres, 1 / radius if radius else 0.0) for metres, radius in model.road.pieces or []]
    return road_of(pieces, length, model.road.blend)


def _companion(rng: np.random.Generator, c: CutInModel) -> Body:
    return vehicle(rng, c.kind, float(rng.choice([35.0, 60.0, 120.0, 190.0])))
