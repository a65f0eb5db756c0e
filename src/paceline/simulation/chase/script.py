"""A chase by script: where both vehicles are is a closed function of time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from paceline.simulation.chase.motion import Gap, Shaking, Wander, place, winding
from paceline.simulation.chase.projection import Eye, camera_rotation
from paceline.simulation.chase.scene import ChaseScene
from paceline.simulation.chase.world import ChaseWorld, Moment

START = 10.0  # m along the road


class Script:
    """The motions of ``scene``, and the ``world`` that they happen in."""

    def __init__(self, scene: ChaseScene) -> None:
        self.scene = scene
        rng = np.random.default_rng([scene.seed, 31])
        self.speed, self.closing = Wander(rng, 8, 40), Gap(rng, scene.gap)
        length = START + scene.top_speed * (scene.frames / scene.rate + 5) + scene.gap[1] + 340
        self.road = winding(np.random.default_rng([scene.seed, 61]), length, scene.radius)
        self.weaving, self.straying = Wander(rng, 4.0, 12.0), Wander(rng, 8.0, 25.0)
        self.pitching, self.yawing = (Shaking(rng, a * scene.bounce / 300) for a in (2.4, 0.25))
        self.rolling, self.heaving = Shaking(rng, 0.004 * scene.bounce / 4), Shaking(rng, 0.02 * scene.bounce / 4)
        self.leaning, self.lifting = Wander(rng, 0.8, 4.0), Wander(rng, 0.5, 3.0)
        self.world = ChaseWorld(scene, self.road, START, self.arc, rng)

    def arc(self, t: float) -> float:
        """Of the chase vehicle along the road, m."""
        return START + self.scene.top_speed * (0.75 * t + 0.25 * self.speed.integral(t))

    def moment(self, t: float) -> Moment:
        """Everything at ``t`` seconds."""
        scene, v = self.scene, self.scene.top_speed * (0.75 + 0.25 * self.speed(t))
        chase = place(self.road, self.arc(t), 0.35 * self.straying(t), 0.35 * self.straying.rate(t) / v)
        gap, closing = self.closing(t)
        weave = 1.7 * scene.weave
        lead = place(self.road, chase.arc + gap, weave * self.weaving(t), weave * self.weaving.rate(t) / (v + closing))
        eye = Eye(
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
