"""A chase by script: where both vehicles are is a closed function of time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from paceline.simulation.chase.motion import CameraShake, GapProfile, SmoothNoise, road_pose, winding_road
from paceline.simulation.chase.projection import CameraPose, camera_rotation
from paceline.simulation.chase.scene import ChaseScene
from paceline.simulation.chase.world import ChaseWorld, WorldState

START_ARC_M = 10.0  # m along the road


class ChaseScript:
    """The motions of ``scene``, and the ``world`` that they happen in."""

    def __init__(self, scene: ChaseScene) -> None:
        self.scene = scene
        rng = np.random.default_rng([scene.seed, 31])
        self.speed, self.closing = SmoothNoise(rng, 8, 40), GapProfile(rng, scene.gap)
        length = START_ARC_M + scene.top_speed * (scene.frames / scene.rate + 5) + scene.gap[1] + 340
        self.road = winding_road(np.random.default_rng([scene.seed, 61]), length, scene.radius)
        self.weaving, self.straying = SmoothNoise(rng, 4.0, 12.0), SmoothNoise(rng, 8.0, 25.0)
        self.pitching, self.yawing = (CameraShake(rng, a * scene.bounce / 300) for a in (2.4, 0.25))
        self.rolling, self.heaving = (
            CameraShake(rng, 0.004 * scene.bounce / 4),
            CameraShake(rng, 0.02 * scene.bounce / 4),
        )
        self.leaning, self.lifting = SmoothNoise(rng, 0.8, 4.0), SmoothNoise(rng, 0.5, 3.0)
        self.world = ChaseWorld(scene, self.road, START_ARC_M, self.arc, rng)

    def arc(self, t: float) -> float:
        """Of the chase vehicle along the road, m."""
        return START_ARC_M + self.scene.top_speed * (0.75 * t + 0.25 * self.speed.integral(t))

    def moment(self, t: float) -> WorldState:
        """Everything at ``t`` seconds."""
        scene, v = self.scene, self.scene.top_speed * (0.75 + 0.25 * self.speed(t))
        chase = road_pose(self.road, self.arc(t), 0.35 * self.straying(t), 0.35 * self.straying.rate(t) / v)
        gap, closing = self.closing(t)
        weave = 1.7 * scene.weave
        lead = road_pose(
            self.road, chase.arc + gap, weave * self.weaving(t), weave * self.weaving.rate(t) / (v + closing)
        )
        eye = CameraPose(
            scene.camera.K,
            camera_rotation(scene.tilt + self.pitching(t), self.rolling(t)),
            scene.camera_height + self.heaving(t),
            chase.x,
            chase.y,
            chase.heading + self.yawing(t),
        )
        later = 0.25 * scene.top_speed * self.speed.rate(t) + (self.closing(t + 0.05)[1] - closing) / 0.05
        return self.world.moment(
            t,
            eye,
            chase,
            replace(lead, heading=lead.heading + scene.yaw),
            lead_roll=0.008 * self.leaning(t),
            lead_lift=0.015 * self.lifting(t),
            sweep=(self.yawing.rate(t), self.pitching.rate(t)),
            braking=scene.brakes and later < -0.5,
        )
