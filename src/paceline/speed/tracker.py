"""Stereo tracking of one vehicle with a particle filter: [Zhu] section III."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from paceline.cameras import StereoRig
from paceline.documents import VehicleDocument
from paceline.recordings import StereoFrame
from paceline.speed import acquisition, likelihood, motion
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.likelihood import Grid, Observation
from paceline.speed.motion import FreeMotion, PathMotion, State
from paceline.speed.particles import Weights, resample
from paceline.speed.paths import Path
from paceline.speed.planes import first_plane, squared
from paceline.speed.registration import Appearance

Array = NDArray[np.float64]

ROUGHENING = 0.1  # share of a static parameter's spread that resampling gives back to it
SEEN = 0.55  # likeness to the reference below which a frame teaches nothing
LOST = 0.25  # likeness below which the vehicle is not in view
PATIENCE = 4  # frames that may pass so before the vehicle is given up
SURE = 0.9  # likeness at which even a surprising registration is believed
SURPRISING = 50.0  # squared standard deviations, of three: so far off, something else may have been found
ALIVE = 0.2  # share of the first particles that the second frame leaves alive
TINY = 1e-12  # m², keeps a covariance positive definite
DIRECTED = 2.0  # m, a travel that has a direction


@dataclass(frozen=True, eq=False)
class Estimate:
    """The filter's estimate at one frame (SI units, ideal pixels)."""

    frame: int
    time: float
    speed: float
    speed_std: float
    position: Array  # (3,)
    yaw_rate: float  # rad/s, positive to the right; NaN at the first frame
    left: Array  # (4, 2)
    right: Array  # (4, 2)
    ess: float
    status: str  # tracking | lost | ended
    likeness: float  # correlation with the reference, −1 … 1
    particles_left: Array  # (N, 2)
    particles_right: Array  # (N, 2)


class Tracker:
    """Follows one vehicle through a recording, a frame at a time::

        tracker = Tracker(rig, vehicle, path)
        for frame in recording.frames(vehicle.frame):
            estimate = tracker.update(frame)

    ``path`` (None for free motion) is the drawn one, not yet moved by ``lateral_offset`` to the lane's centre: which
    side is right is known only when the vehicle has moved. Afterwards ``self.path`` is the way that it goes. The first
    update takes the operator's quadrilaterals as they are.
    """

    def __init__(
        self,
        rig: StereoRig,
        vehicle: VehicleDocument,
        path: Path | None = None,
        lateral_offset: float = 0.0,
        configuration: SpeedConfiguration | None = None,
    ) -> None:
        self.rig = rig
        self.vehicle = vehicle
        self.configuration = c = configuration or SpeedConfiguration()
        self.path = path
        self.status = "tracking"
        self.rng = np.random.default_rng([c.seed, *vehicle.id.encode()])
        self.grid = Grid.for_region(c.parts, vehicle.left)
        self.plane = first_plane(rig, vehicle, path, c.click_sigma)
        self.appearance = Appearance(rig, self.grid, vehicle.left, c.reference_memory) if c.guided else None
        self.ways = [] if path is None else [way.shifted(lateral_offset) for way in (path, path.reversed())]
        moving = [PathMotion(rig, way, c) for way in self.ways]
        self._motions: list[PathMotion | FreeMotion] = [*moving] or [FreeMotion(rig, c)]
        self.state: State
        self.weights: Weights
        self.motion: PathMotion | FreeMotion
        self._first: StereoFrame | None = None
        self._time = 0.0
        self._unseen = 0

    def update(self, frame: StereoFrame) -> Estimate:
        """The estimate at ``frame``; raises RuntimeError once the track has ended."""
        if self.status != "tracking":
            raise RuntimeError(f"vehicle {self.vehicle.id} is {self.status}")
        dt = frame.time - self._time
        if self._first is None:
            estimate = self._begin(frame)
        else:
            if self._time == self._first.time:
                self._acquire(frame, dt)
            else:
                self.state = self.motion.propagate(self.state, dt, self.rng)
                self._guide(frame)
            self._look(frame, self.state)
            self.weights = self.weights.updated(self._log_likelihood(self._observe(self.state)))
            estimate = self._estimate(frame, dt)
            self._resample()
        self._time = frame.time
        return estimate

    # --- the first two frames ----------------------------------------------------------------------------------------

    def _begin(self, frame: StereoFrame) -> Estimate:
        """The first frame: the reference, and the depth at which the views agree."""
        c = self.configuration
        if self.appearance is not None:
            with suppress(np.linalg.LinAlgError):  # without texture the plane stays where it was outlined
                self.plane = self.appearance.begin((frame.left, frame.right), self.vehicle.left, self.plane)
        searched = acquisition.SEARCH if self.vehicle.speed is None else 1
        self.state = acquisition.initial_state(self.plane, self.vehicle, c.particles * searched, self.rng)
        self.weights = Weights.equal(len(self.state))
        self._look(frame, self.state)
        self.reference = self._observe(self.state[np.zeros(1, np.int64)]).features[0]
        self._first = frame
        return Estimate(
            frame=frame.index,
            time=frame.time,
            speed=self.vehicle.speed or float("nan"),
            speed_std=float("nan"),
            position=self.plane.centre,
            yaw_rate=float("nan"),
            left=self.vehicle.left,
            right=self.vehicle.right,
            ess=float(c.particles),
            status="tracking",
            likeness=1.0,
            particles_left=motion.diagonal_crossings(self.state.left[: c.particles]),
            particles_right=motion.diagonal_crossings(self.state.right[: c.particles]),
        )

    def _acquire(self, frame: StereoFrame, dt: float) -> None:
        """The second frame: which way the vehicle drives, and how fast."""
        outcomes, first = [], self.state
        for way in self._motions:
            start = self._set_off(first, way, frame, dt, self.vehicle.speed)
            state = way.propagate(start, dt, self.rng)
            self._look(frame, state)
            lw = self._log_likelihood(self._observe(state))
            outcomes.append((float(np.logaddexp.reduce(lw)), state, lw, way))
        _, self.state, lw, self.motion = max(outcomes, key=lambda o: o[0])
        if isinstance(self.motion, PathMotion):
            self.path = self.motion.path
        self.weights = Weights(lw) if self.appearance is None else _tempered(lw)
        found = self._registered(frame)
        if found is None:
            self._resample()
            return
        # how sure the first speed is follows from registration alone: weights would leave too few particles to say
        start, guess = first[np.arange(self.configuration.particles)], float(self.weights.mean(self.state.speed))
        self.state = self.motion.propagate(self._set_off(start, self.motion, frame, dt, guess), dt, self.rng)
        self.weights = Weights.equal(len(self.state))
        self._correct(*found)

    def _set_off(
        self, start: State, way: PathMotion | FreeMotion, frame: StereoFrame, dt: float, guess: float | None
    ) -> State:
        """The first particles, set off along ``way``."""
        if isinstance(way, PathMotion):
            return acquisition.along_path(start, self.plane, way, self.rig, guess, self.configuration, self.rng)
        assert self._first is not None
        images = self._first.left, frame.left
        return acquisition.as_matched(start, self.plane, self.rig, self.vehicle, *images, dt, self.rng)

    # --- every further frame -----------------------------------------------------------------------------------------

    def _guide(self, frame: StereoFrame) -> None:
        """Move the particles by what registration saw: the weighted ensemble Kalman filter's proposal.

        The paper's dynamics model alone proposes blindly. Here every particle takes the Kalman step that the whole
        cloud's covariance gives between where its plane is and everything else in its state.
        """
        found = self._registered(frame)
        if found is not None:
            self._correct(*found)

    def _registered(self, frame: StereoFrame) -> tuple[Array, Array] | None:
        """Where registration saw the plane's centre (3,), and its covariance; None where it saw nothing to believe."""
        if self.appearance is None:
            return None
        w, state, mean = self.weights, self.state, self._mean()
        doubt = float(np.hypot(*w.std(motion.diagonal_crossings(state.left))))
        images = frame.left, frame.right
        try:
            found = self.appearance.find(images, mean.left[0], mean.normal[0], float(mean.distance[0]), doubt)
        except np.linalg.LinAlgError:  # nothing there that could be told from anything else
            return None
        places = motion.centres(self.rig, state)
        spread = w.covariance(places) + found.covariance
        surprise = float(found.shift @ np.linalg.solve(spread, found.shift))
        if found.likeness < (SEEN if surprise < SURPRISING else SURE):
            return None
        self.appearance.learn(found)
        return w.mean(places) + found.shift, found.covariance

    def _correct(self, place: Array, covariance: Array) -> None:
        """The ensemble Kalman step of all particles towards the ``place`` (3,) that was seen."""
        places = motion.centres(self.rig, self.state)
        noise = self.rng.normal(0.0, 1.0, places.shape) @ np.linalg.cholesky(covariance + TINY * np.eye(3)).T
        W = self.weights.W
        self.state = motion.corrected(self.rig, self.state, W, places, place + noise, covariance, self.motion)

    def _look(self, frame: StereoFrame, state: State) -> None:
        """Make the images ready for sampling where the particles look."""
        self._views = likelihood.pack(frame.left, state.left), likelihood.pack(frame.right, state.right)

    def _observe(self, state: State) -> Observation:
        left, right = self._views
        return likelihood.observe(
            left, right, state.left, state.right, motion.cross_homographies(self.rig, state), self.grid
        )

    def _log_likelihood(self, seen: Observation) -> Array:
        c = self.configuration
        return likelihood.log_likelihood(seen, self.reference, c.lambda_single, c.lambda_cross)

    def _mean(self) -> State:
        """The posterior mean (3), as a state of one particle."""
        return State(*(self.weights.mean(getattr(self.state, name))[None] for name in State.__dataclass_fields__))

    def _estimate(self, frame: StereoFrame, dt: float) -> Estimate:
        """The posterior mean (3), and the reference's update (14) from what it sees."""
        w, state, mean = self.weights, self.state, self._mean()
        position = w.mean(motion.centres(self.rig, state))
        likeness = self._learn(mean)
        if likeness < LOST:
            self._unseen += 1
        elif likeness > SEEN:  # a passing likeness of something else is no sight of it
            self._unseen = 0
        if self._outside(mean, position):
            self.status = "ended"
        elif self._unseen >= PATIENCE:
            self.status = "lost"
        estimate = Estimate(
            frame=frame.index,
            time=frame.time,
            speed=float(w.mean(state.speed)),
            speed_std=float(w.std(state.speed)),
            position=position,
            yaw_rate=self.motion.yaw_rate(mean, dt),
            left=mean.left[0],
            right=mean.right[0],
            ess=w.ESS,
            status=self.status,
            likeness=likeness,
            particles_left=motion.diagonal_crossings(state.left),
            particles_right=motion.diagonal_crossings(state.right),
        )
        self._square(position)
        return estimate

    def _learn(self, mean: State) -> float:
        """Update the reference (14) by what the estimate sees, unless that is unlike it; returns the likeness."""
        seen = self._observe(mean).features[0]
        both = np.stack([seen, self.reference]).reshape(2, 2, -1)  # (seen and reference, views, features)
        norms = np.linalg.norm(both, axis=2).prod(0)
        likeness = float(((both[0] * both[1]).sum(1) / np.maximum(norms, 1e-6)).mean())
        if likeness > SEEN:
            memory = self.configuration.reference_memory
            self.reference = memory * self.reference + (1 - memory) * seen
        return likeness

    def _outside(self, mean: State, position: Array) -> bool:
        """Whether the region has left an image, or the vehicle is upon the cameras."""
        for quad, camera in ((mean.left[0], self.rig.left), (mean.right[0], self.rig.right)):
            beyond = (quad < 0) | (quad > np.array(camera.image_size) - 1) | ~np.isfinite(quad)
            if beyond.any():
                return True
        return bool(position[2] < 1.0)

    def _square(self, position: Array) -> None:
        """Set a plane of unknown normal square to the travel so far, once that is long enough to have a direction."""
        travel = position - self.plane.centre
        if self.vehicle.plane == "free" and np.linalg.norm(travel) > DIRECTED:
            centres = motion.centres(self.rig, self.state)
            normal = squared(self.plane, travel).normal
            self.state = replace(self.state, normal=np.tile(normal, (len(centres), 1)), distance=centres @ normal)

    def _resample(self) -> None:
        c, N = self.configuration, len(self.state)
        if c.resample_below * N < self.weights.ESS and c.particles == N:
            return
        index = resample(c.resampling, self.weights.W, self.rng)
        if c.particles < N:
            index = self.rng.permutation(index)[: c.particles]
        spread = self.weights.std(self.state.heading)
        self.state = self.state[index]
        # a static parameter is drawn to its mean as it is stirred, so that its spread stays what it was
        mean = self.state.heading.mean(0)
        kept = np.sqrt(1 - ROUGHENING**2) * (self.state.heading - mean)
        stirred = self.rng.normal(0.0, ROUGHENING, self.state.heading.shape) * spread
        self.state = replace(self.state, heading=mean + kept + stirred)
        self.weights = Weights.equal(len(index))


def _tempered(lw: Array) -> Weights:
    """Weights by a power of the likelihood that leaves particles enough alive for a covariance that means something."""
    weights = Weights(lw)
    while ALIVE * len(lw) > weights.ESS:
        lw = 0.5 * lw
        weights = Weights(lw)
    return weights
