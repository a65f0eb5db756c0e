"""A scripted chase: the poses of both vehicles as closed-form functions of time."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from paceline.simulation.chase.motion import (
    CameraShake,
    CameraVibration,
    GapProfile,
    SmoothNoise,
    road_pose,
    winding_road,
)
from paceline.simulation.chase.projection import CameraPose, camera_rotation
from paceline.simulation.chase.scene import ChaseScene
from paceline.simulation.chase.world import ChaseWorld, WorldState

SCRIPT_START_ARC_M = 10.0  # m along the road


class ChaseScript:
    """The motion of both vehicles of ``scene``, and its ``world``."""

    def __init__(self, scene: ChaseScene) -> None:
        self.scene = scene
        rng = np.random.default_rng([scene.seed, 31])
        self.speed, self.gap = SmoothNoise(rng, 8, 40), GapProfile(rng, scene.gap)
        length = SCRIPT_START_ARC_M + scene.top_speed * (scene.frames / scene.rate + 5) + scene.gap[1] + 340
        self.road = winding_road(np.random.default_rng([scene.seed, 61]), length, scene.radius)
        self.lead_weave, self.camera_drift = SmoothNoise(rng, 4.0, 12.0), SmoothNoise(rng, 8.0, 25.0)
        self.pitch_shake, self.yaw_shake = (CameraShake(rng, a * scene.shake_px / 300) for a in (2.4, 0.25))
        self.roll_shake, self.heave_shake = (
            CameraShake(rng, 0.004 * scene.shake_px / 4),
            CameraShake(rng, 0.02 * scene.shake_px / 4),
        )
        self.vibration = CameraVibration(np.random.default_rng([scene.seed, 67]), scene.vibration)
        self.lead_roll, self.lead_lift = SmoothNoise(rng, 0.8, 4.0), SmoothNoise(rng, 0.5, 3.0)
        self.world = ChaseWorld(scene, self.road, SCRIPT_START_ARC_M, self.arc, rng)

    def arc(self, t: float) -> float:
        """Arc length (m) of the chase vehicle along the road."""
        return SCRIPT_START_ARC_M + self.scene.top_speed * (0.75 * t + 0.25 * self.speed.integral(t))

    def state_at(self, t: float) -> WorldState:
        """The state of the world at ``t`` s."""
        scene, v = self.scene, self.scene.top_speed * (0.75 + 0.25 * self.speed(t))
        chase = road_pose(self.road, self.arc(t), 0.35 * self.camera_drift(t), 0.35 * self.camera_drift.rate(t) / v)
        gap, closing = self.gap(t)
        weave = 1.7 * scene.weave
        lead = road_pose(
            self.road, chase.arc + gap, weave * self.lead_weave(t), weave * self.lead_weave.rate(t) / (v + closing)
        )
        camera = CameraPose(
            scene.camera.K,
            cv2.Rodrigues(self.vibration(t))[0] @ camera_rotation(scene.tilt + self.pitch_shake(t), self.roll_shake(t)),
            scene.camera_height + self.heave_shake(t),
            chase.x,
            chase.y,
            chase.heading + self.yaw_shake(t),
        )
        later = 0.25 * scene.top_speed * self.speed.rate(t) + (self.gap(t + 0.05)[1] - closing) / 0.05
        nodding, turning, _ = self.vibration.rate(t)
        return self.world.state_at(
            t,
            camera,
            chase,
            replace(lead, heading=lead.heading + scene.yaw),
            lead_roll=0.008 * self.lead_roll(t),
            lead_lift=0.015 * self.lead_lift(t),
            image_motion=(self.yaw_shake.rate(t) + turning, -self.pitch_shake.rate(t) - nodding),
            braking=scene.brakes and later < -0.5,
        )
