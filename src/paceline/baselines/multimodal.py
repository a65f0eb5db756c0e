"""Multimodal stereo particle tracking, a comparison method of [Zhu] section V.

R. Muñoz-Salinas, M. García-Silvente, R. Medina Carnicer, "Adaptive multi-modal stereo people tracking without
background modelling" (2008), with the two changes of [Zhu]: the person's ellipses become a quadrangle, the vehicle's
outlined plane; and depth is measured along the plane's normal, which the path's direction gives, because the plane does
not face the cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.baselines import image_cues
from paceline.baselines.disparity import DepthMap, Rectification
from paceline.baselines.template_tracking import MAX_MISSED_FRAMES, TemplateTracker
from paceline.baselines.track import (
    NOISE_STEP_S,
    FrameResult,
    check_frame_count,
    measurement_of_filter,
    rejected,
    unseen_frame,
)
from paceline.baselines.triangulation_covariance import triangulation_covariance
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.geometry import triangulate
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.resampling import Weights, resample
from paceline.speed.geometry.initial_plane import plane_from_outlines
from paceline.speed.geometry.paths import Path, level_frames
from paceline.speed.measurement import by_vehicle
from paceline.speed.methods import register
from paceline.speed.results import Measurement
from paceline.verdicts import message

LAMBDA_GREY = 20.0  # weight of 1 − Bhattacharyya coefficient in the log-likelihood
LAMBDA_EDGE = 5.0  # weight of 1 − gradient relative to that of the best particle
DISPARITY_SIGMA_PX = 0.5  # standard deviation of a box's mean disparity
SMOOTHING_DISCOUNT = 0.95  # discount δ of kernel smoothing
REFERENCE_UPDATE_SHARE = 0.1  # weight of the present histogram in the new reference
MIN_UPDATE_SIMILARITY = 0.8  # similarity above which the reference is updated
MIN_BOX_SIMILARITY = 0.5  # similarity below which the vehicle is not in view
CROP_MARGIN_SHARE = 0.3  # image margin around the particles, as a share of the box's longer side
MAX_PARTICLE_MARGINS = 5.0  # margins beyond which particles are ignored in the choice of the crop


@dataclass(frozen=True, eq=False)
class Particles:
    """N particles: ``places`` (N, 3) m of the plane's centre, and ``velocities`` (N, 3) m/s along, across and down the
    path."""

    places: Array
    velocities: Array


class Multimodal:
    """The particle filter of one vehicle; ``path`` is the drawn one, if any."""

    def __init__(
        self, rig: StereoRig, vehicle: VehicleDocument, path: Path | None, configuration: SpeedConfiguration
    ) -> None:
        self.rig, self.vehicle, self.path, self.configuration = rig, vehicle, path, configuration
        self.rng = np.random.default_rng([configuration.seed, *vehicle.id.encode()])
        self.rectified = Rectification(rig)
        self.plane = plane_from_outlines(rig, vehicle, path, configuration.click_sigma)
        rays = rig.left.rays(vehicle.left)
        on_plane = rays * (self.plane.distance / (rays @ self.plane.normal))[:, None]
        self.corners = on_plane - self.plane.centre  # (4, 3) m
        self.frame_results: list[FrameResult] = []
        self._templates: TemplateTracker | None = None
        self._particles: Particles | None = None
        self._axes = np.eye(3)  # columns along, across, down at the first place
        self._reference: Array
        self._time = 0.0
        self._unseen = 0

    def process(self, frame: StereoFrame) -> bool:
        """Process ``frame``; whether the vehicle can be tracked further."""
        if self._templates is None:
            return self._initialize(frame)
        dt = frame.time - self._time
        if self._particles is None:
            self._particles = self._draw_particles(frame, dt)
            if self._particles is None:
                further = self._templates.record_missed(frame.time)
                self.frame_results.append(unseen_frame(frame, self._templates))
                return further
        particles, self._time = self._propagate(self._particles, dt), frame.time
        axes = self._axes_at(particles.places.mean(0))
        depths = self._depths(frame, particles.places, axes)
        weights = Weights(self._log_likelihood(particles.places, axes, depths))
        further = self._record(frame, particles, weights, axes, depths)
        self._particles = self._smooth(particles, weights)
        return further

    # --- the first two frames ---------------------------------------------------------------------------------------

    def _initialize(self, frame: StereoFrame) -> bool:
        try:
            self._templates = TemplateTracker(self.rig, np.stack([self.vehicle.left, self.vehicle.right]), frame)
        except np.linalg.LinAlgError:
            return False
        centre, self._time = self.plane.centre, frame.time
        depths = self._depths(frame, centre[None], self._axes)
        self._reference = self._histograms_at(centre[None], self._axes, depths)[0]
        self.frame_results.append(
            FrameResult(
                frame=frame.index,
                time=frame.time,
                left=self.vehicle.left,
                right=self.vehicle.right,
                speed=self.vehicle.speed or float("nan"),
                position=centre,
                effective_points=float(self.configuration.particles),
            )
        )
        return True

    def _draw_particles(self, frame: StereoFrame, dt: float) -> Particles | None:
        """Initial particles from the region found in the second frame; None where it is not found."""
        assert self._templates is not None
        moves = self._templates.find(frame)
        if moves is None:
            return None
        c, N, centre = self.configuration, self.configuration.particles, self.plane.centre
        left, right = (m(q).mean(0) for m, q in zip(moves, self._templates.quads, strict=True))
        step = triangulate(self.rig, left, right) - triangulate(self.rig, *self._templates.quads.mean(1))
        self._axes = level_frames(step) if self.path is None else self._axes_at(centre)
        velocity = self._axes.T @ step / dt
        # of two places by one region each: over a short time their difference contains little information
        spread = self._axes.T @ triangulation_covariance(self.rig, centre, DISPARITY_SIGMA_PX) @ self._axes * 2 / dt**2
        if self.vehicle.speed is not None:
            velocity[0] = np.copysign(self.vehicle.speed, velocity[0])
            spread[0] = spread[:, 0] = 0.0
        if self.path is not None:
            velocity[1:] = spread[1:] = spread[:, 1:] = 0.0
        spread[0, 0] += (c.speed_guess_spread * velocity[0]) ** 2
        velocities = self.rng.multivariate_normal(velocity, spread, N, check_valid="ignore")
        deeper = 1 / (1 + self.plane.inverse_depth_std * self.rng.normal(size=N))
        return Particles(centre * deeper[:, None], velocities)

    # --- every further frame ----------------------------------------------------------------------------------------

    def _propagate(self, particles: Particles, dt: float) -> Particles:
        """The particles ``dt`` seconds later: constant velocity along the path, with the noises of [Zhu]."""
        c, N = self.configuration, self.configuration.particles
        if self.path is None:
            walks = np.array([c.translation_noise] * 3)
            drifts = np.array([c.distance_noise] * 3)
        else:
            walks = np.array([c.speed_noise, 0.0, 0.0])
            drifts = np.array([c.distance_noise, c.lateral_noise, c.vertical_noise])
        growth = np.sqrt(dt / NOISE_STEP_S)
        velocities = particles.velocities + growth * walks * self.rng.normal(size=(N, 3))
        middle = particles.places.mean(0)
        axes = self._axes_at(middle + 0.5 * dt * self._axes_at(middle) @ velocities.mean(0))
        steps = dt * velocities + growth * drifts * self.rng.normal(size=(N, 3))
        return Particles(particles.places + steps @ axes.T, velocities)

    def _axes_at(self, place: Array) -> Array:
        """Unit vectors along, across and down the path at ``place`` (3,), as columns (3, 3)."""
        return self._axes if self.path is None else self.path.frames(np.array(self.path.nearest(place)))

    def _boxes(self, places: Array, axes: Array) -> Array:
        """World corners (N, 4, 3) of the plane at ``places`` (N, 3), rotated with the path."""
        return np.asarray(places[:, None] + self.corners @ (axes @ self._axes.T).T)

    def _depths(self, frame: StereoFrame, places: Array, axes: Array) -> DepthMap:
        """The depth map of a crop around ``places`` (N, 3), without a few outliers, searched about their depth."""
        boxes = self.rectified.project(self._boxes(places, axes))
        middle = np.median(boxes, axis=0)
        margin = CROP_MARGIN_SHARE * float(np.ptp(middle, axis=0).max())
        low, high = np.quantile(boxes, [0.02, 0.98], axis=0)
        low = np.maximum(low.min(0), middle.min(0) - MAX_PARTICLE_MARGINS * margin) - margin
        high = np.minimum(high.max(0), middle.max(0) + MAX_PARTICLE_MARGINS * margin) + margin
        depth = float(np.median(places @ self.rectified.rotation[2]))
        return self.rectified.depths((frame.left, frame.right), np.stack([low, high]), depth)

    def _histograms_at(self, places: Array, axes: Array, depths: DepthMap) -> Array:
        """Histograms (N, HISTOGRAM_BINS) of the boxes at ``places`` (N, 3)."""
        boxes = self.rectified.project(self._boxes(places, axes)) - depths.low
        return image_cues.histograms(image_cues.sample_nearest(depths.grey, image_cues.sample_points(boxes)))

    def _log_likelihood(self, places: Array, axes: Array, depths: DepthMap) -> Array:
        """Logarithms (N,) of the likelihoods of grey levels, edges and depth at ``places`` (N, 3).

        Depth counts by how much of it the disparity map holds.
        """
        boxes = self.rectified.project(self._boxes(places, axes)) - depths.low
        grey = LAMBDA_GREY * (image_cues.bhattacharyya(self._histograms_at(places, axes, depths), self._reference) - 1)
        strength = image_cues.edge_strengths(image_cues.image_gradients(depths.grey), boxes)
        edge = LAMBDA_EDGE * (strength / max(float(strength.max()), 1e-9) - 1)
        # depth along the plane's normal is the same all over the plane, however it is turned
        normal, inside = axes @ self._axes.T @ self.plane.normal, image_cues.sample_points(boxes)
        along = image_cues.sample_nearest(depths.Z, inside) * (self.rectified.rays(inside + depths.low) @ normal)
        mean, confidence = image_cues.mean_of_finite(along)
        Z = places @ self.rectified.rotation[2]
        sigma = np.maximum(Z**2 / self.rectified.fb * DISPARITY_SIGMA_PX, 1e-9)
        return np.asarray(grey + edge - 0.5 * confidence * ((mean - places @ normal) / sigma) ** 2)

    def _smooth(self, particles: Particles, weights: Weights) -> Particles:
        """Resampled particles after kernel smoothing (Liu and West 2001): shrinkage to the mean and jitter, which
        together preserve mean and covariance."""
        state = np.concatenate([particles.places, particles.velocities], axis=1)
        a = (3 * SMOOTHING_DISCOUNT - 1) / (2 * SMOOTHING_DISCOUNT)
        values, vectors = np.linalg.eigh(weights.covariance(state))
        kernel = vectors * np.sqrt(np.maximum(values, 0.0) * (1 - a**2))
        resampled = state[resample(self.configuration.resampling, weights.W, self.rng)]
        resampled = a * resampled + (1 - a) * weights.mean(state) + self.rng.normal(size=resampled.shape) @ kernel.T
        return Particles(resampled[:, :3], resampled[:, 3:])

    # --- results -----------------------------------------------------------------------------------------------------

    def _record(
        self, frame: StereoFrame, particles: Particles, weights: Weights, axes: Array, depths: DepthMap
    ) -> bool:
        """Records the estimate at ``frame``; whether the vehicle can be tracked further."""
        place, velocity = weights.mean(particles.places), weights.mean(particles.velocities)
        histograms = self._histograms_at(place[None], axes, depths)[0]
        similarity = float(image_cues.bhattacharyya(histograms, self._reference))
        if similarity > MIN_UPDATE_SIMILARITY:
            self._reference = (1 - REFERENCE_UPDATE_SHARE) * self._reference + REFERENCE_UPDATE_SHARE * histograms
        self._unseen = self._unseen + 1 if similarity < MIN_BOX_SIMILARITY else 0
        left, right = self.rig.project(self._boxes(place[None], axes)[0])
        status = "tracking" if similarity >= MIN_BOX_SIMILARITY else "lost"
        if self._outside(left, right) or place[2] < 1.0:
            status = "ended"
        points_left, points_right = self.rig.project(particles.places)
        self.frame_results.append(
            FrameResult(
                frame=frame.index,
                time=frame.time,
                left=left,
                right=right,
                status=status,
                speed=float(np.linalg.norm(velocity)),
                speed_std=float(weights.std(np.linalg.norm(particles.velocities, axis=1))),
                position=place,
                points_left=points_left,
                points_right=points_right,
                effective_points=weights.ESS,
            )
        )
        return status != "ended" and self._unseen < MAX_MISSED_FRAMES

    def _outside(self, left: Array, right: Array) -> bool:
        return any(
            not ((quad >= 0) & (quad <= np.array(camera.image_size) - 1)).all()
            for quad, camera in zip((left, right), self.rig.cameras, strict=True)
        )

    def result(self) -> Measurement:
        """The measurement: the mean of the filter's speeds, weighted by their inverse variances."""
        name = self.vehicle.id
        if not self.frame_results:
            test = "the equations of its motion are singular"
            return rejected(name, self.frame_results, message("too_little_texture", test=test))
        if too_few := check_frame_count(self.frame_results, self.configuration.limits):
            return rejected(name, self.frame_results, too_few)
        return measurement_of_filter(name, self.frame_results, "particle filter", self.configuration.limits)


register("multimodal", by_vehicle(lambda clip, vehicle, path, c: Multimodal(clip.rig, vehicle, path, c), on_paths=True))
