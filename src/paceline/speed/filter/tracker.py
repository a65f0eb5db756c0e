"""Stereo tracking of one vehicle with a particle filter: [Zhu] section III."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from paceline.arrays import Array, Floats
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import random_numbers
from paceline.speed.filter.batch import step
from paceline.speed.filter.estimate import (
    MIN_REFERENCE_SIMILARITY,
    MIN_VISIBLE_SIMILARITY,
    Estimate,
    estimate_from,
    has_left_image,
    initial_estimate,
)
from paceline.speed.filter.initialization import Initialization, is_heading_known
from paceline.speed.filter.likelihood import ObservationModel, PartGrid, Views, pack_views
from paceline.speed.filter.motion_models import CoordinatedTurn, FreeMotion, PathMotion
from paceline.speed.filter.particle_set import CPU, Device, Particles
from paceline.speed.filter.registration import ReferenceTexture, register_plane, update_by_registration
from paceline.speed.geometry.initial_plane import (
    Face,
    likeliest_face,
    normal_of_face,
    plane_across,
    plane_from_outlines,
)
from paceline.speed.geometry.paths import Path, both_ways


class Tracker:
    """Tracks one vehicle through a recording, a frame at a time::

        tracker = Tracker(rig, vehicle, path)
        for frame in recording.frames(vehicle.frame):
            estimate = tracker.update(frame)

    ``path`` (None for free motion) is the drawn one, not yet shifted by ``lateral_offset`` to the lane's centre: which
    side is right is known only when the vehicle has moved. From the second frame on ``self.path`` is the path in the
    direction of travel, where the particles keep to it. The first update takes the operator's quadrilaterals as they
    are. From the second frame on the particles are on ``device``. Raises ValueError for a resampling scheme that the
    device does not have.
    """

    def __init__(
        self,
        rig: StereoRig,
        vehicle: VehicleDocument,
        path: Path | None = None,
        lateral_offset: float = 0.0,
        configuration: SpeedConfiguration | None = None,
        device: Device | None = None,
    ) -> None:
        self.rig = rig
        self.vehicle = vehicle
        self.configuration = c = configuration or SpeedConfiguration()
        self.path = path
        self.status = "tracking"
        self.device = device or CPU
        if c.resampling not in self.device.resampling_schemes:
            expected = ", ".join(self.device.resampling_schemes)
            raise ValueError(f"resampling: {c.resampling}: expected {expected}, the only scheme that there is on a GPU")
        self.rng = random_numbers.make_generator([c.seed, *vehicle.id.encode()], c.particles)
        grid = PartGrid.for_region(c.parts, vehicle.left)
        self.model = ObservationModel(rig, grid, c)
        self.texture = ReferenceTexture(rig, grid, vehicle.left, c.reference_memory) if c.guided else None
        self.plane = plane_from_outlines(rig, vehicle, path, c.click_sigma)
        self._compare_displaced(vehicle.displacement)
        self.candidate_paths = [] if path is None else both_ways(path, lateral_offset)
        self._motions = candidate_motions(rig, self.candidate_paths, c)
        self.particle_set: Particles
        self._views: Views
        self._features: Floats  # (2, parts, 16) of the estimate in both views
        self._estimate: Estimate
        self._first: StereoFrame | None = None
        self._time = 0.0
        self._occluded_frames = 0
        self._face: Face | None = None  # of the vehicle, that is outlined
        self._is_aligned = False  # whether the planes are aligned with the direction of travel by it

    def update(self, frame: StereoFrame) -> Estimate:
        """The estimate at ``frame``; raises RuntimeError once the track has ended."""
        if self.status != "tracking":
            raise RuntimeError(f"vehicle {self.vehicle.id} is {self.status}")
        return step([self], frame)[0] if self.is_initialized else self.initialize(frame)

    # --- one step, in the order of `batch.step` ----------------------------------------------------------------------

    def predict(self, frame: StereoFrame) -> None:
        """Move the particles to ``frame``; at the second frame draw them by direction and speed of the vehicle."""
        if self._has_speed:
            self.particle_set.propagate(frame.time - self._time, self.rng)
            return
        assert self._first is not None
        start = self.particle_set.to_host().state
        self.particle_set = self._initialization.initialize_speed(frame, self._first, start)
        if isinstance(self.particle_set.motion, PathMotion):
            self.path = self.particle_set.motion.path

    def displace(self, frame: StereoFrame) -> None:
        """Let the planes move from the left exposure to the right one by the particles' mean velocity."""
        if self._has_speed and frame.skew:
            displacement = self.particle_set.motion.velocity(self.particle_set.mean()) * frame.skew
            self._compare_displaced(displacement)
            self.particle_set.displace(displacement)

    def _compare_displaced(self, displacement: Array) -> None:
        """Compare the two views of a plane that moves by ``displacement`` (3,) m between their exposures."""
        rig = self.rig.displaced(displacement)
        self.model.rig = rig
        if self.texture is not None:
            self.texture.rig = rig

    def register(self, frame: StereoFrame) -> None:
        """Move the particles by the registered position of the plane: the proposal of the weighted ensemble Kalman
        filter [Papadakis et al. 2010].

        The paper proposes from the dynamics alone. Here each particle takes the Kalman step whose gain comes from the
        covariance, over all particles, between the position of the plane and the rest of the state.
        """
        if self.texture is None or not self._has_speed:
            return
        observation = register_plane(self.texture, self.particle_set, frame)
        if observation is not None and observation.inside_gate:
            update_by_registration(self.texture, self.particle_set, observation, self.rng)

    def weight(self, views: Views) -> None:
        """Update the weights (2) by the likelihood (12)."""
        self._views = views
        self.particle_set.weight(self.model, views)

    def estimate(self, frame: StereoFrame) -> Estimate:
        """The posterior mean (3), and whether the vehicle is in view.

        Where it is occluded the weights before this frame are restored: the occluder would select a few particles by
        chance.
        """
        posterior = self.particle_set.posterior()
        self._features = self.model.observe(self._views, posterior.mean).features[0]
        similarity = self.model.similarity(self._features)
        if similarity < MIN_VISIBLE_SIMILARITY:
            self.particle_set.restore_weights()
            posterior = self.particle_set.posterior()
            self._occluded_frames += 1
        elif similarity > MIN_REFERENCE_SIMILARITY:  # between the two it may be similar by chance
            self._occluded_frames = 0
        if has_left_image(posterior, self.rig):
            self.status = "ended"
        elif self._occluded_frames >= self.configuration.tracking.max_occluded_frames:
            self.status = "lost"
        yaw_rate = self.particle_set.motion.yaw_rate(posterior.mean, frame.time - self._time)
        self._estimate = estimate_from(posterior, frame, yaw_rate, similarity, self.status, self.vehicle.id)
        self._time = frame.time
        return self._estimate

    def update_reference(self) -> None:
        """Update the reference features (14), unless those of the estimate are unlike them."""
        if self._estimate.similarity > MIN_REFERENCE_SIMILARITY:
            self.model.update(self._features)

    def resample(self) -> None:
        """Resample the particles where the vehicle is in view; free their memory where the track has ended."""
        if self.status != "tracking":
            del self.particle_set
            return
        if self._estimate.similarity >= MIN_VISIBLE_SIMILARITY:
            self.particle_set.resample(self.configuration, self.rng)
        travel = self._estimate.position - self.plane.centre
        if not is_heading_known(travel):
            return
        if isinstance(self.particle_set.motion, CoordinatedTurn):
            mean = self.particle_set.mean()
            if not self._is_aligned:
                self._face = likeliest_face(self.rig, self.vehicle, self.plane, mean.velocity[0])
                self._is_aligned = True
            if self._face is not None:
                self.particle_set.set_plane_normal(normal_of_face(mean.normal[0], mean.velocity[0], self._face))
        elif self.vehicle.plane == "free":
            self.particle_set.set_plane_normal(plane_across(self.plane, travel).normal)

    # --- the first two frames ----------------------------------------------------------------------------------------

    @property
    def is_initialized(self) -> bool:
        """Whether the first frame has been processed."""
        return self._first is not None

    @property
    def _has_speed(self) -> bool:
        """Whether the second frame has been processed."""
        return self._first is not None and self._time != self._first.time

    @property
    def _initialization(self) -> Initialization:
        c, device, rng = self.configuration, self.device, self.rng
        motions, paths = self._motions, self.candidate_paths
        return Initialization(
            self.rig, self.vehicle, c, motions, paths, self.model, self.texture, self.plane, device, rng
        )

    def initialize(self, frame: StereoFrame) -> Estimate:
        """The first frame: the reference, and the depth at which the views agree."""
        self.plane, particle_set = self._initialization.initialize_plane(frame)
        self.particle_set, state = particle_set, particle_set.state
        self.model.initialize(pack_views(frame, [particle_set.image_bounds()]), state[np.zeros(1, np.int64)])
        self._first, self._time = frame, frame.time
        return initial_estimate(frame, self.vehicle, self.plane, state, self.configuration.particles)

    # --- checkpoints -------------------------------------------------------------------------------------------------

    def checkpoint(self) -> dict[str, object]:
        """All that the next update starts from, in the computer's memory, to continue there after `restore`."""
        state = dict(self.__dict__, device=CPU, rng=copy.deepcopy(self.rng), model=copy.copy(self.model))
        state["texture"] = copy.copy(self.texture)
        if "particle_set" in state:
            state["particle_set"] = self.particle_set.checkpoint()
        return state

    def restore(self, state: dict[str, object]) -> None:
        """Continue from a `checkpoint`, on the CPU."""
        self.__dict__.update(state)
        if "particle_set" in state:
            self.particle_set = self.particle_set.to_host()


def candidate_motions(
    rig: StereoRig, paths: Sequence[Path], configuration: SpeedConfiguration
) -> list[PathMotion | FreeMotion]:
    """The motions between which the first two frames decide: along each of the candidate ``paths``, or a free one.

    On a curve that does not have to be kept exactly, guided particles turn freely: the turn that the images show is
    more certain than that of a reconstructed curve, which remains the prior of the refinement.
    """
    c = configuration
    if paths and (paths[0].shape == "line" or c.exact_path or not c.guided):
        return [PathMotion(rig, path, c) for path in paths]
    return [CoordinatedTurn(rig, c) if c.guided else FreeMotion(rig, c)]
