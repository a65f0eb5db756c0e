"""Multimodal stereo particle tracking, as [Zhu] section V compares with.

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
from paceline.baselines.template_tracking import PATIENCE, Regions
from paceline.baselines.track import Sight, filtered, rejected, too_few, unseen
from paceline.baselines.triangulation_covariance import covariance
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

FRAME = 0.2  # s, the step that the configuration's noises belong to
LAMBDA_GREY = 20.0  # on 1 − Bhattacharyya's coefficient
LAMBDA_EDGE = 5.0  # on what the sides' gradient lacks to that of the best particle
DISPARITY_SIGMA = 0.5  # px, of a box's mean disparity
DISCOUNT = 0.95  # δ of kernel smoothing
ADAPTING = 0.1  # share of what is seen in the new reference
ALIKE = 0.8  # likeness above which the reference is adapted
LOST = 0.5  # likeness below which the vehicle is not in view
AROUND = 0.3  # lengths of the box's longer side, of picture about the particles
REACH = 5.0  # of these, beyond which particles are strays


@dataclass(frozen=True, eq=False)
class Cloud:
    """N particles: ``places`` (N, 3) m of the plane's centre, and ``velocities`` (N, 3) m/s along, across and down the
    way."""

    places: Array
    velocities: Array


class Multimodal:
    """One vehicle on its way through the clip; ``path`` is that of its lane where it has one."""

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
        self.sights: list[Sight] = []
        self._regions: Regions | None = None
        self._cloud: Cloud | None = None
        self._axes = np.eye(3)  # columns along, across, down at the first place
        self._reference: Array
        self._time = 0.0
        self._unseen = 0

    def process(self, frame: StereoFrame) -> bool:
        """Follow the vehicle into ``frame``; whether it can be followed further."""
        if self._regions is None:
            return self._begin(frame)
        dt = frame.time - self._time
        if self._cloud is None:
            self._cloud = self._set_off(frame, dt)
            if self._cloud is None:
                further = self._regions.miss(frame.time)
                self.sights.append(unseen(frame, self._regions))
                return further
        cloud, self._time = self._propagated(self._cloud, dt), frame.time
        axes = self._axes_at(cloud.places.mean(0))
        depths = self._depths(frame, cloud.places, axes)
        weights = Weights(self._log_likelihood(cloud.places, axes, depths))
        further = self._note(frame, cloud, weights, axes, depths)
        self._cloud = self._smoothed(cloud, weights)
        return further

    # --- the first two frames ---------------------------------------------------------------------------------------

    def _begin(self, frame: StereoFrame) -> bool:
        try:
            self._regions = Regions(self.rig, np.stack([self.vehicle.left, self.vehicle.right]), frame)
        except np.linalg.LinAlgError:
            return False
        centre, self._time = self.plane.centre, frame.time
        depths = self._depths(frame, centre[None], self._axes)
        self._reference = self._seen_at(centre[None], self._axes, depths)[0]
        self.sights.append(
            Sight(
                frame=frame.index,
                time=frame.time,
                left=self.vehicle.left,
                right=self.vehicle.right,
                speed=self.vehicle.speed or float("nan"),
                position=centre,
                strength=float(self.configuration.particles),
            )
        )
        return True

    def _set_off(self, frame: StereoFrame, dt: float) -> Cloud | None:
        """The first particles, by where the region is found in the second frame; None where it is not."""
        assert self._regions is not None
        moves = self._regions.find(frame)
        if moves is None:
            return None
        c, N, centre = self.configuration, self.configuration.particles, self.plane.centre
        left, right = (m(q).mean(0) for m, q in zip(moves, self._regions.quads, strict=True))
        step = triangulate(self.rig, left, right) - triangulate(self.rig, *self._regions.quads.mean(1))
        self._axes = level_frames(step) if self.path is None else self._axes_at(centre)
        velocity = self._axes.T @ step / dt
        # of two places by one region each: over a short time their step says little
        spread = self._axes.T @ covariance(self.rig, centre, DISPARITY_SIGMA) @ self._axes * 2 / dt**2
        if self.vehicle.speed is not None:
            velocity[0] = np.copysign(self.vehicle.speed, velocity[0])
            spread[0] = spread[:, 0] = 0.0
        if self.path is not None:
            velocity[1:] = spread[1:] = spread[:, 1:] = 0.0
        spread[0, 0] += (c.speed_guess_spread * velocity[0]) ** 2
        velocities = self.rng.multivariate_normal(velocity, spread, N, check_valid="ignore")
        deeper = 1 / (1 + self.plane.inverse_depth_std * self.rng.normal(size=N))
        return Cloud(centre * deeper[:, None], velocities)

    # --- every further frame ----------------------------------------------------------------------------------------

    def _propagated(self, cloud: Cloud, dt: float) -> Cloud:
        """The particles ``dt`` seconds later: constant velocity along the way, with the noises of [Zhu]."""
        c, N = self.configuration, self.configuration.particles
        if self.path is None:
            walks = np.array([c.translation_noise] * 3)
            drifts = np.array([c.distance_noise] * 3)
        else:
            walks = np.array([c.speed_noise, 0.0, 0.0])
            drifts = np.array([c.distance_noise, c.lateral_noise, c.vertical_noise])
        growth = np.sqrt(dt / FRAME)
        velocities = cloud.velocities + growth * walks * self.rng.normal(size=(N, 3))
        middle = cloud.places.mean(0)
        axes = self._axes_at(middle + 0.5 * dt * self._axes_at(middle) @ velocities.mean(0))
        steps = dt * velocities + growth * drifts * self.rng.normal(size=(N, 3))
        return Cloud(cloud.places + steps @ axes.T, velocities)

    def _axes_at(self, place: Array) -> Array:
        """Columns (3, 3) along, across and down the way at ``place`` (3,)."""
        return self._axes if self.path is None else self.path.frames(np.array(self.path.nearest(place)))

    def _boxes(self, places: Array, axes: Array) -> Array:
        """World corners (N, 4, 3) of the plane at ``places`` (N, 3), turned with the way."""
        return np.asarray(places[:, None] + self.corners @ (axes @ self._axes.T).T)

    def _depths(self, frame: StereoFrame, places: Array, axes: Array) -> DepthMap:
        """The depth map about all of ``places`` (N, 3) but a few strays, where about their depth is expected."""
        boxes = self.rectified.project(self._boxes(places, axes))
        middle = np.median(boxes, axis=0)
        margin = AROUND * float(np.ptp(middle, axis=0).max())
        low, high = np.quantile(boxes, [0.02, 0.98], axis=0)
        low = np.maximum(low.min(0), middle.min(0) - REACH * margin) - margin
        high = np.minimum(high.max(0), middle.max(0) + REACH * margin) + margin
        depth = float(np.median(places @ self.rectified.rotation[2]))
        return self.rectified.depths((frame.left, frame.right), np.stack([low, high]), depth)

    def _seen_at(self, places: Array, axes: Array, depths: DepthMap) -> Array:
        """Histograms (N, BINS) of the boxes at ``places`` (N, 3)."""
        boxes = self.rectified.project(self._boxes(places, axes)) - depths.low
        return image_cues.histograms(image_cues.picked(depths.grey, image_cues.inside(boxes)))

    def _log_likelihood(self, places: Array, axes: Array, depths: DepthMap) -> Array:
        """Logarithms (N,) of the likelihoods of grey levels, edges and depth at ``places`` (N, 3).

        Depth counts by how much of it the disparity map holds.
        """
        boxes = self.rectified.project(self._boxes(places, axes)) - depths.low
        grey = LAMBDA_GREY * (image_cues.likeness(self._seen_at(places, axes, depths), self._reference) - 1)
        strength = image_cues.edge_strengths(image_cues.slopes(depths.grey), boxes)
        edge = LAMBDA_EDGE * (strength / max(float(strength.max()), 1e-9) - 1)
        # depth along the plane's normal is the same all over the plane, however it is turned
        normal, inside = axes @ self._axes.T @ self.plane.normal, image_cues.inside(boxes)
        along = image_cues.picked(depths.Z, inside) * (self.rectified.rays(inside + depths.low) @ normal)
        mean, confidence = image_cues.mean_known(along)
        Z = places @ self.rectified.rotation[2]
        sigma = np.maximum(Z**2 / self.rectified.fb * DISPARITY_SIGMA, 1e-9)
        return np.asarray(grey + edge - 0.5 * confidence * ((mean - places @ normal) / sigma) ** 2)

    def _smoothed(self, cloud: Cloud, weights: Weights) -> Cloud:
        """Resampled particles, drawn to their mean and stirred as much: kernel smoothing (Liu and West 2001), which
        leaves mean and covariance as they are."""
        state = np.concatenate([cloud.places, cloud.velocities], axis=1)
        a = (3 * DISCOUNT - 1) / (2 * DISCOUNT)
        values, vectors = np.linalg.eigh(weights.covariance(state))
        kernel = vectors * np.sqrt(np.maximum(values, 0.0) * (1 - a**2))
        kept = state[resample(self.configuration.resampling, weights.W, self.rng)]
        kept = a * kept + (1 - a) * weights.mean(state) + self.rng.normal(size=kept.shape) @ kernel.T
        return Cloud(kept[:, :3], kept[:, 3:])

    # --- what is found ----------------------------------------------------------------------------------------------

    def _note(self, frame: StereoFrame, cloud: Cloud, weights: Weights, axes: Array, depths: DepthMap) -> bool:
        """Keep the estimate at ``frame``; whether the vehicle can be followed further."""
        place, velocity = weights.mean(cloud.places), weights.mean(cloud.velocities)
        seen = self._seen_at(place[None], axes, depths)[0]
        alike = float(image_cues.likeness(seen, self._reference))
        if alike > ALIKE:
            self._reference = (1 - ADAPTING) * self._reference + ADAPTING * seen
        self._unseen = self._unseen + 1 if alike < LOST else 0
        left, right = self.rig.project(self._boxes(place[None], axes)[0])
        status = "tracking" if alike >= LOST else "lost"
        if self._outside(left, right) or place[2] < 1.0:
            status = "ended"
        points_left, points_right = self.rig.project(cloud.places)
        self.sights.append(
            Sight(
                frame=frame.index,
                time=frame.time,
                left=left,
                right=right,
                status=status,
                speed=float(np.linalg.norm(velocity)),
                speed_std=float(weights.std(np.linalg.norm(cloud.velocities, axis=1))),
                position=place,
                points_left=points_left,
                points_right=points_right,
                strength=weights.ESS,
            )
        )
        return status != "ended" and self._unseen < PATIENCE

    def _outside(self, left: Array, right: Array) -> bool:
        return any(
            not ((quad >= 0) & (quad <= np.array(camera.image_size) - 1)).all()
            for quad, camera in zip((left, right), self.rig.cameras, strict=True)
        )

    def result(self) -> Measurement:
        """The measurement: the filter's speeds, averaged by what they claim to know."""
        name = self.vehicle.id
        if not self.sights:
            test = "the equations of its motion are singular"
            return rejected(name, self.sights, message("too_little_texture", test=test))
        if few := too_few(self.sights, self.configuration.limits):
            return rejected(name, self.sights, few)
        return filtered(name, self.sights, "particle filter", self.configuration.limits)


register("multimodal", by_vehicle(lambda clip, vehicle, path, c: Multimodal(clip.rig, vehicle, path, c), on_paths=True))
