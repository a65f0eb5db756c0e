"""The weighted particles of one vehicle: their interface, and the set in the computer's memory.

`cuda.particle_set.CudaParticleSet` is the set on a GPU.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import motion_models
from paceline.speed.filter.likelihood import ObservationModel, Views
from paceline.speed.filter.motion_models import NO_DISPLACEMENT, FreeMotion, PathMotion, State
from paceline.speed.filter.resampling import (
    JITTER_SCALE,
    RESAMPLING_SCHEMES,
    SHRINKAGE,
    Weights,
    ess_sufficient,
    resample,
)

MAX_DRAWN_PARTICLES = 2000  # particles at most whose projections an estimate contains


@dataclass(frozen=True, eq=False)
class Posterior:
    """Moments of the weighted particles (SI units): their mean (3), as a state of one, and standard deviations."""

    mean: State
    position: Array  # (3,) the mean of the planes' centres
    speed: float
    speed_std: float
    ess: float
    particles_left: Array  # (N, 2) px, the planes' projected centres, of about MAX_DRAWN_PARTICLES particles at most
    particles_right: Array  # (N, 2) px


class Particles(Protocol):
    """The weighted particles of one vehicle, on a CPU or a GPU."""

    motion: PathMotion | FreeMotion

    def propagate(self, dt: float, rng: np.random.Generator) -> None:
        """Move all particles on by ``dt`` seconds."""

    def displace(self, displacement: Array) -> None:
        """Let the planes move by ``displacement`` (3,) m from the left exposure to the right one."""

    def mean(self) -> State:
        """The posterior mean (3), as a state of one particle."""

    def image_spread_px(self) -> float:
        """Standard deviation of the planes' projected centres in the left view, in pixels."""

    def centre(self) -> tuple[Array, Array]:
        """Mean (3,) and covariance (3, 3) of the planes' centres, m."""

    def ensemble_kalman_update(self, place: Array, covariance: Array, rng: np.random.Generator) -> None:
        """The ensemble Kalman update by a measured ``place`` (3,) m of the plane's centre."""

    def image_bounds(self) -> tuple[Array, Array]:
        """Pixels (…, 2) of each view whose bounding box contains the regions of all particles."""

    def weight(self, model: ObservationModel, views: Views) -> None:
        """Update the weights by the likelihood of the images of ``views`` ([Zhu] (2))."""

    def restore_weights(self) -> None:
        """Restore the weights before the last update."""

    def posterior(self) -> Posterior:
        """The moments of the weighted particles."""

    def set_plane_normal(self, normal: Array) -> None:
        """Give every plane the ``normal`` (3,), about its own centre."""

    def resample(self, c: SpeedConfiguration, rng: np.random.Generator) -> None:
        """Draw ``c.particles`` particles by their weights, unless the effective sample size is sufficient."""

    def to_host(self) -> ParticleSet:
        """A copy in the computer's memory."""

    def checkpoint(self) -> Checkpoint:
        """The particles as they are now."""


class Checkpoint(Protocol):
    """Particles as they were."""

    def to_host(self) -> ParticleSet:
        """A copy in the computer's memory."""


class ParticleSet:
    """N particles in the computer's memory: their ``state`` at the left exposure and ``weights``; they move by
    ``motion``, and by ``displacement`` (3,) m until the right exposure."""

    def __init__(
        self,
        rig: StereoRig,
        motion: PathMotion | FreeMotion,
        state: State,
        weights: Weights,
        displacement: Array = NO_DISPLACEMENT,
    ) -> None:
        self.rig, self.motion, self.displacement = rig, motion, displacement
        self.state, self.weights = state, weights
        self._previous_weights = weights

    def propagate(self, dt: float, rng: np.random.Generator) -> None:
        self.state = self.motion.propagate(self.state, dt, rng, self.displacement)

    def displace(self, displacement: Array) -> None:
        self.displacement = displacement

    def mean(self) -> State:
        return State(*(self.weights.mean(getattr(self.state, name))[None] for name in State.__dataclass_fields__))

    def image_spread_px(self) -> float:
        return float(np.hypot(*self.weights.std(motion_models.diagonal_crossings(self.state.left))))

    def centre(self) -> tuple[Array, Array]:
        places = motion_models.plane_centres(self.rig, self.state)
        return self.weights.mean(places), self.weights.covariance(places)

    def ensemble_kalman_update(self, place: Array, covariance: Array, rng: np.random.Generator) -> None:
        noise = rng.normal(0.0, 1.0, (len(self.state), 3)) @ motion_models.cholesky_factor(covariance).T
        W = self.weights.W
        self.state = motion_models.ensemble_kalman_update(
            self.rig, self.state, W, place + noise, covariance, self.motion, self.displacement
        )

    def image_bounds(self) -> tuple[Array, Array]:
        return self.state.left, self.state.right

    def weight(self, model: ObservationModel, views: Views) -> None:
        self.update_weights(model.log_likelihood(views, self.state))

    def update_weights(self, log_likelihood: Array) -> None:
        """Update the weights by log p(z | x) (N,) ([Zhu] (2))."""
        self._previous_weights = self.weights
        self.weights = self.weights.updated(log_likelihood)

    def restore_weights(self) -> None:
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
        self.state = motion_models.with_normal(self.rig, self.state, normal)

    def resample(self, c: SpeedConfiguration, rng: np.random.Generator) -> None:
        N = len(self.state)
        if c.particles == N and ess_sufficient(self.weights.ESS, N, c.resample_below):
            return
        index = resample(c.resampling, self.weights.W, rng)
        if c.particles < N:
            index = rng.permutation(index)[: c.particles]
        spread = self.weights.std(self.state.heading)
        self.state = self.state[index]
        # kernel shrinkage keeps the variance of a static parameter when it is jittered [Liu and West 2001]
        mean = self.state.heading.mean(0)
        jitter = rng.normal(0.0, JITTER_SCALE, self.state.heading.shape) * spread
        self.state = replace(self.state, heading=mean + SHRINKAGE * (self.state.heading - mean) + jitter)
        self.weights = Weights.equal(len(index))

    def to_host(self) -> ParticleSet:
        return ParticleSet(self.rig, self.motion, self.state, self.weights, self.displacement)

    def checkpoint(self) -> ParticleSet:
        return self.to_host()


class Device(Protocol):
    """Where particles are computed."""

    resampling_schemes: Collection[str]

    def particle_set(self, host: ParticleSet) -> Particles:
        """``host`` moved there."""

    def log_likelihood(self, model: ObservationModel, views: Views, state: State) -> Array:
        """log p(z | x) (N,) of particles that are in the computer's memory."""


class Cpu:
    """The CPU as a `Device`."""

    resampling_schemes: Collection[str] = RESAMPLING_SCHEMES

    def particle_set(self, host: ParticleSet) -> Particles:
        return host

    def log_likelihood(self, model: ObservationModel, views: Views, state: State) -> Array:
        return model.log_likelihood(views, state)


CPU = Cpu()
