"""A vehicle's weighted particles, and what the filter does with them, in the computer's own memory.

`cuda.particle_set.CudaParticleSet` does the same on a GPU.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import likelihood, motion_models
from paceline.speed.filter.likelihood import PackedImage
from paceline.speed.filter.motion_models import FreeMotion, PathMotion, State
from paceline.speed.filter.resampling import JITTER_SCALE, SHRINKAGE, Weights, ess_sufficient, resample

Views = tuple[PackedImage, PackedImage]

MAX_DRAWN_PARTICLES = 2000  # particles at most, of which an estimate tells the places


@dataclass(frozen=True, eq=False)
class Posterior:
    """What the weighted particles come to: their mean (3), as a state of one, and spreads (SI units)."""

    mean: State
    position: Array  # (3,) the mean of the planes' centres
    speed: float
    speed_std: float
    ess: float
    particles_left: Array  # (N, 2) px, the planes' projected centres, of MAX_DRAWN_PARTICLES or a few more particles
    particles_right: Array  # (N, 2) px


class ParticleSet:
    """``state`` and ``weights`` of N particles that move by ``motion``."""

    def __init__(self, rig: StereoRig, motion: PathMotion | FreeMotion, state: State, weights: Weights) -> None:
        self.rig, self.motion = rig, motion
        self.state, self.weights = state, weights
        self._previous_weights = weights

    def propagate(self, dt: float, rng: np.random.Generator) -> None:
        """Move all particles on by ``dt`` seconds."""
        self.state = self.motion.propagate(self.state, dt, rng)

    def mean(self) -> State:
        """The posterior mean (3), as a state of one particle."""
        return State(*(self.weights.mean(getattr(self.state, name))[None] for name in State.__dataclass_fields__))

    def image_spread_px(self) -> float:
        """How far apart the particles see the plane's centre in the left view, in pixels."""
        return float(np.hypot(*self.weights.std(motion_models.diagonal_crossings(self.state.left))))

    def centre(self) -> tuple[Array, Array]:
        """Mean (3,) and covariance (3, 3) of the planes' centres."""
        places = motion_models.plane_centres(self.rig, self.state)
        return self.weights.mean(places), self.weights.covariance(places)

    def ensemble_kalman_update(self, place: Array, covariance: Array, rng: np.random.Generator) -> None:
        """The ensemble Kalman step of all particles towards the ``place`` (3,) where the plane's centre was seen."""
        places = motion_models.plane_centres(self.rig, self.state)
        noise = rng.normal(0.0, 1.0, places.shape) @ motion_models.cholesky_factor(covariance).T
        W = self.weights.W
        self.state = motion_models.ensemble_kalman_update(
            self.rig, self.state, W, places, place + noise, covariance, self.motion
        )

    def image_bounds(self) -> tuple[Array, Array]:
        """Pixels (…, 2) of each view between which the particles look."""
        return self.state.left, self.state.right

    def weight(self, log_likelihood: Array) -> None:
        """Update the weights by log p(z | x) (N,) ([Zhu] (2))."""
        self._previous_weights = self.weights
        self.weights = self.weights.updated(log_likelihood)

    def restore_weights(self) -> None:
        """Take the last update of the weights back."""
        self.weights = self._previous_weights

    def posterior(self) -> Posterior:
        w, state = self.weights, self.state
        every = -(-len(state) // MAX_DRAWN_PARTICLES)
        return Posterior(
            mean=self.mean(),
            position=w.mean(motion_models.plane_centres(self.rig, state)),
            speed=float(w.mean(state.speed)),
            speed_std=float(w.std(state.speed)),
            ess=w.ESS,
            particles_left=motion_models.diagonal_crossings(state.left[::every]),
            particles_right=motion_models.diagonal_crossings(state.right[::every]),
        )

    def set_plane_normal(self, normal: Array) -> None:
        """Set every plane square to ``normal`` (3,), about its own centre."""
        centres = motion_models.plane_centres(self.rig, self.state)
        self.state = replace(self.state, normal=np.tile(normal, (len(centres), 1)), distance=centres @ normal)

    def resample(self, c: SpeedConfiguration, rng: np.random.Generator) -> None:
        """Draw as many particles as ``c`` asks for by their weights, unless these are even enough."""
        N = len(self.state)
        if c.particles == N and ess_sufficient(self.weights.ESS, N, c.resample_below):
            return
        index = resample(c.resampling, self.weights.W, rng)
        if c.particles < N:
            index = rng.permutation(index)[: c.particles]
        spread = self.weights.std(self.state.heading)
        self.state = self.state[index]
        # a static parameter is drawn to its mean as it is stirred, so that its spread stays what it was
        mean = self.state.heading.mean(0)
        stirred = rng.normal(0.0, JITTER_SCALE, self.state.heading.shape) * spread
        self.state = replace(self.state, heading=mean + SHRINKAGE * (self.state.heading - mean) + stirred)
        self.weights = Weights.equal(len(index))

    def to_host(self) -> ParticleSet:
        """A copy in the computer's memory."""
        return ParticleSet(self.rig, self.motion, self.state, self.weights)

    def checkpoint(self) -> ParticleSet:
        """Of which `to_host` gives the cloud as it is now."""
        return self.to_host()


def pack_views(frame: StereoFrame, reaches: Iterable[tuple[Array, Array]]) -> Views:
    """Both images of ``frame``, ready for sampling where particles with these ``reaches`` look."""
    left, right = (np.concatenate([places.reshape(-1, 2) for places in side]) for side in zip(*reaches, strict=True))
    return likelihood.pack(frame.left, left), likelihood.pack(frame.right, right)
