"""Stereo tracking of one vehicle with a particle filter: [Zhu] section III."""

from __future__ import annotations

import copy
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import initialization, likelihood, motion_models, random_numbers
from paceline.speed.filter.estimate import Estimate
from paceline.speed.filter.initialization import (
    MAX_START_ITERATIONS,
    START_STEP_TOLERANCE,
    SpeedPrior,
    tempered_weights,
)
from paceline.speed.filter.likelihood import Observation, PartGrid
from paceline.speed.filter.motion_models import FreeMotion, PathMotion, State
from paceline.speed.filter.particle_set import MAX_DRAWN_PARTICLES, ParticleSet, Posterior, Views, pack_views
from paceline.speed.filter.registration import ReferenceTexture, Registration
from paceline.speed.filter.resampling import Weights
from paceline.speed.geometry.initial_plane import plane_across, plane_from_outlines
from paceline.speed.geometry.paths import Path

if TYPE_CHECKING:
    from paceline.speed.filter.cuda.device import CudaDevice
    from paceline.speed.filter.cuda.particle_set import CudaParticleSet


MIN_REFERENCE_SIMILARITY = 0.55  # likeness to the reference below which a frame teaches nothing
MIN_VISIBLE_SIMILARITY = 0.25  # likeness below which the vehicle is not in view
MIN_SIMILARITY_OUTSIDE_GATE = 0.9  # likeness at which even a surprising registration is believed
GATE_CHI2 = 50.0  # squared standard deviations, of three: so far off, something else may have been found
MIN_HEADING_TRAVEL_M = 2.0  # m, a travel that has a direction


@dataclass(frozen=True, eq=False)
class PlaneObservation:
    """Where registration saw the plane's centre: its ``place`` (3,), m, what was ``found`` there, and whether that is
    to be ``believed``."""

    place: Array
    found: Registration
    believed: bool


class Tracker:
    """Follows one vehicle through a recording, a frame at a time::

        tracker = Tracker(rig, vehicle, path)
        for frame in recording.frames(vehicle.frame):
            estimate = tracker.update(frame)

    ``path`` (None for free motion) is the drawn one, not yet moved by ``lateral_offset`` to the lane's centre: which
    side is right is known only when the vehicle has moved. Afterwards ``self.path`` is the way that it goes. The first
    update takes the operator's quadrilaterals as they are. With a ``device`` the particles live there from the second
    frame on. Raises ValueError for a resampling that the device does not know.
    """

    def __init__(
        self,
        rig: StereoRig,
        vehicle: VehicleDocument,
        path: Path | None = None,
        lateral_offset: float = 0.0,
        configuration: SpeedConfiguration | None = None,
        device: CudaDevice | None = None,
    ) -> None:
        self.rig = rig
        self.vehicle = vehicle
        self.configuration = c = configuration or SpeedConfiguration()
        self.path = path
        self.status = "tracking"
        self.device = device
        if device is not None and c.resampling != "systematic":
            raise ValueError(f"resampling: {c.resampling}: expected systematic, the only scheme that there is on a GPU")
        self.rng = random_numbers.make_generator([c.seed, *vehicle.id.encode()], c.particles)
        self.grid = PartGrid.for_region(c.parts, vehicle.left)
        self.plane = plane_from_outlines(rig, vehicle, path, c.click_sigma)
        self.appearance = ReferenceTexture(rig, self.grid, vehicle.left, c.reference_memory) if c.guided else None
        self.ways = [] if path is None else [way.shifted(lateral_offset) for way in (path, path.reversed())]
        moving = [PathMotion(rig, way, c) for way in self.ways]
        self._motions: list[PathMotion | FreeMotion] = [*moving] or [FreeMotion(rig, c)]
        self.particle_set: ParticleSet | CudaParticleSet
        self.views: Views
        self._first: StereoFrame | None = None
        self._time = 0.0
        self._unseen = 0

    def update(self, frame: StereoFrame) -> Estimate:
        """The estimate at ``frame``; raises RuntimeError once the track has ended."""
        if self.status != "tracking":
            raise RuntimeError(f"vehicle {self.vehicle.id} is {self.status}")
        if self.begins:
            return self._begin(frame)
        self.propose(frame)
        self.guide(frame)
        self.views = pack_views(frame, [self.particle_set.image_bounds()])
        if self.device is not None:
            self.device.weight([self])
        elif isinstance(self.particle_set, ParticleSet):
            self.particle_set.weight(self._log_likelihood(self.particle_set.state))
        return self.conclude(frame, self.judge())

    @property
    def begins(self) -> bool:
        """Whether the next frame is the first."""
        return self._first is None

    @property
    def _acquires(self) -> bool:
        """Whether the next frame is the second."""
        return self._first is not None and self._time == self._first.time

    def propose(self, frame: StereoFrame) -> None:
        """Move the particles to where they may be at ``frame``."""
        dt = frame.time - self._time
        if self._acquires:
            self._acquire(frame, dt)
        else:
            self.particle_set.propagate(dt, self.rng)

    def guide(self, frame: StereoFrame) -> None:
        """Move the particles by what registration saw: the weighted ensemble Kalman filter's proposal.

        The paper's dynamics model alone proposes blindly. Here every particle takes the Kalman step that the whole
        cloud's covariance gives between where its plane is and everything else in its state.
        """
        sight = None if self._acquires else self._sought(frame)
        if sight is not None and sight.believed:
            self._believe(sight)

    def judge(self) -> tuple[float, Posterior | None]:
        """How like the reference is what the weighted particles see, and what they come to; the reference's update.

        Where something hides the vehicle their weights are taken back, and what they come to is another: None. What
        hides it would choose among its particles by chance, and leave but a few.
        """
        posterior = self.particle_set.posterior()
        similarity = self._learn(posterior.mean)
        if similarity >= MIN_VISIBLE_SIMILARITY:
            return similarity, posterior
        self.particle_set.restore_weights()
        return similarity, None

    def conclude(self, frame: StereoFrame, judged: tuple[float, Posterior | None]) -> Estimate:
        """The estimate at ``frame`` by what was ``judged``, and resampling where the vehicle is in view."""
        similarity, posterior = judged
        estimate = self._estimate(frame, similarity, posterior or self.particle_set.posterior())
        self._time = frame.time
        if self.status != "tracking":
            del self.particle_set  # whose room others may need
            return estimate
        if similarity >= MIN_VISIBLE_SIMILARITY:
            self.particle_set.resample(self.configuration, self.rng)
        self._square(estimate.position)
        return estimate

    def checkpoint(self) -> dict[str, object]:
        """All that the next update goes out from, in the computer's memory, to go on there by `restore`."""
        kept = dict(self.__dict__, rng=copy.deepcopy(self.rng), appearance=copy.copy(self.appearance), device=None)
        if "particle_set" in kept:
            kept["particle_set"] = self.particle_set.checkpoint()
        return kept

    def restore(self, kept: dict[str, object]) -> None:
        self.__dict__.update(kept)
        if "particle_set" in kept:
            self.particle_set = self.particle_set.to_host()

    # --- the first two frames ----------------------------------------------------------------------------------------

    def _begin(self, frame: StereoFrame) -> Estimate:
        """The first frame: the reference, and the depth at which the views agree."""
        c = self.configuration
        if self.appearance is not None:
            with suppress(np.linalg.LinAlgError):  # without texture the plane stays where it was outlined
                self.plane = self.appearance.initialize((frame.left, frame.right), self.vehicle.left, self.plane)
        searched = self.configuration.start.particle_factor if self.vehicle.speed is None else 1
        state = initialization.initial_state(self.plane, self.vehicle, c.particles * searched, self.rng)
        self.particle_set = ParticleSet(self.rig, self._motions[0], state, Weights.equal(len(state)))
        self.views = pack_views(frame, [self.particle_set.image_bounds()])
        self.reference = self._observe(state[np.zeros(1, np.int64)]).features[0]
        self._first, self._time = frame, frame.time
        shown = slice(None, c.particles, -(-c.particles // MAX_DRAWN_PARTICLES))
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
            similarity=1.0,
            particles_left=motion_models.diagonal_crossings(state.left[shown]),
            particles_right=motion_models.diagonal_crossings(state.right[shown]),
            vehicle=self.vehicle.id,
        )

    def _acquire(self, frame: StereoFrame, dt: float) -> None:
        """The second frame: which way the vehicle drives, and how fast."""
        assert isinstance(self.particle_set, ParticleSet)
        outcomes, first = [], self.particle_set.state
        guess = initialization.operator_speed(self.vehicle, self.configuration)
        for way in self._motions:
            state = way.propagate(self._set_off(first, way, frame, dt, guess), dt, self.rng)
            self.views = pack_views(frame, [(state.left, state.right)])
            lw = self._log_likelihood(state)
            outcomes.append((float(np.logaddexp.reduce(lw)), state, lw, way))
        _, state, lw, way = max(outcomes, key=lambda o: o[0])
        if isinstance(way, PathMotion):
            self.path = way.path
        self.particle_set = ParticleSet(
            self.rig, way, state, Weights(lw) if self.appearance is None else tempered_weights(lw)
        )
        likeliest, sight = self.particle_set, self._led(frame, way, first, dt)
        if sight is not None and sight.believed:
            self._believe(sight)
        else:
            self.particle_set = likeliest
            self.particle_set.resample(self.configuration, self.rng)
        if self.device is not None:
            self.particle_set = self.device.particle_set(self.particle_set)

    def _led(
        self, frame: StereoFrame, way: PathMotion | FreeMotion, first: State, dt: float
    ) -> PlaneObservation | None:
        """Where registration leads from the likeliest speeds, the particles set off anew with what it found.

        By weights the likeliest of many speeds may be far off, and would leave too few particles to say how sure it
        is. Along a path registration is repeated from where it leads: speeds that lie far apart have no mean region to
        begin from.
        """
        start, sight = first[np.arange(self.configuration.particles)], self._sought(frame)
        for _ in range(MAX_START_ITERATIONS if isinstance(way, PathMotion) else 1):
            if sight is None or sight.found.similarity < MIN_REFERENCE_SIMILARITY:
                break
            before = sight.place
            guess = initialization.speed_prior(
                sight.place, sight.found.covariance, self.plane, way, dt, self.vehicle, self.configuration
            )
            state = way.propagate(self._set_off(start, way, frame, dt, guess), dt, self.rng)
            self.particle_set = ParticleSet(self.rig, way, state, Weights.equal(len(state)))
            sight = self._sought(frame)
            if sight is not None and float(np.linalg.norm(sight.place - before)) < START_STEP_TOLERANCE * guess[0] * dt:
                break
        return sight

    def _set_off(
        self, start: State, way: PathMotion | FreeMotion, frame: StereoFrame, dt: float, guess: SpeedPrior | None
    ) -> State:
        """The first particles, set off along ``way``."""
        if isinstance(way, PathMotion):
            return initialization.draw_path_start(start, self.plane, way, self.rig, guess, self.configuration, self.rng)
        assert self._first is not None
        images = self._first.left, frame.left
        return initialization.draw_free_start(
            start, self.plane, self.rig, self.vehicle, *images, dt, self.configuration, self.rng
        )

    # --- every further frame -----------------------------------------------------------------------------------------

    def _believe(self, sight: PlaneObservation) -> None:
        """Correct the particles by what was seen, and learn what it looks like."""
        assert self.appearance is not None
        self.particle_set.ensemble_kalman_update(sight.place, sight.found.covariance, self.rng)
        self.appearance.update(sight.found)

    def _sought(self, frame: StereoFrame) -> PlaneObservation | None:
        """Where registration sees the plane; None where nothing there could be told from anything else."""
        if self.appearance is None:
            return None
        mean, doubt = self.particle_set.mean(), self.particle_set.image_spread_px()
        images = frame.left, frame.right
        try:
            found = self.appearance.register(images, mean.left[0], mean.normal[0], float(mean.distance[0]), doubt)
        except np.linalg.LinAlgError:
            return None
        # the mean region is not where the mean of the planes projects to, while the speed is hardly known
        place = motion_models.plane_centres(self.rig, mean)[0] + found.shift
        centre, covariance = self.particle_set.centre()
        aside = place - centre
        surprise = float(aside @ np.linalg.solve(covariance + found.covariance, aside))
        return PlaneObservation(
            place,
            found,
            found.similarity >= (MIN_REFERENCE_SIMILARITY if surprise < GATE_CHI2 else MIN_SIMILARITY_OUTSIDE_GATE),
        )

    def _observe(self, state: State) -> Observation:
        left, right = self.views
        return likelihood.observe(
            left, right, state.left, state.right, motion_models.cross_homographies(self.rig, state), self.grid
        )

    def _log_likelihood(self, state: State) -> Array:
        if self.device is not None:
            return self.device.log_likelihood(self, state)
        c = self.configuration
        return likelihood.log_likelihood(self._observe(state), self.reference, c.lambda_single, c.lambda_cross)

    def _estimate(self, frame: StereoFrame, similarity: float, posterior: Posterior) -> Estimate:
        """The posterior mean (3), and whether the vehicle is still there."""
        mean, position = posterior.mean, posterior.position
        if similarity < MIN_VISIBLE_SIMILARITY:
            self._unseen += 1
        elif similarity > MIN_REFERENCE_SIMILARITY:  # a passing likeness of something else is no sight of it
            self._unseen = 0
        if self._outside(mean, position):
            self.status = "ended"
        elif self._unseen >= self.configuration.tracking.max_occluded_frames:
            self.status = "lost"
        return Estimate(
            frame=frame.index,
            time=frame.time,
            speed=posterior.speed,
            speed_std=posterior.speed_std,
            position=position,
            yaw_rate=self.particle_set.motion.yaw_rate(mean, frame.time - self._time),
            left=mean.left[0],
            right=mean.right[0],
            ess=posterior.ess,
            status=self.status,
            similarity=similarity,
            particles_left=posterior.particles_left,
            particles_right=posterior.particles_right,
            vehicle=self.vehicle.id,
        )

    def _learn(self, mean: State) -> float:
        """Update the reference (14) by what the estimate sees, unless that is unlike it; returns the likeness."""
        seen = self._observe(mean).features[0]
        both = np.stack([seen, self.reference]).reshape(2, 2, -1)  # (seen and reference, views, features)
        norms = np.linalg.norm(both, axis=2).prod(0)
        similarity = float(((both[0] * both[1]).sum(1) / np.maximum(norms, 1e-6)).mean())
        if similarity > MIN_REFERENCE_SIMILARITY:
            memory = self.configuration.reference_memory
            self.reference = memory * self.reference + (1 - memory) * seen
        return similarity

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
        if self.vehicle.plane == "free" and np.linalg.norm(travel) > MIN_HEADING_TRAVEL_M:
            self.particle_set.set_plane_normal(plane_across(self.plane, travel).normal)
