"""One vehicle's measurement: tracked frame by frame, refined at the end, accepted or rejected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.documents.loading import Clip, VehicleDocument
from paceline.errors import UnusableInput
from paceline.recordings.stereo import StereoFrame
from paceline.speed import acceptance
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.batch import TrackerBatch
from paceline.speed.filter.estimate import MIN_REFERENCE_SIMILARITY, MIN_VISIBLE_SIMILARITY, Estimate
from paceline.speed.filter.initialization import is_heading_known
from paceline.speed.filter.tracker import Tracker
from paceline.speed.geometry.fitted_arc import fit_arc, travel_along
from paceline.speed.geometry.initial_plane import plane_across, plane_from_outlines
from paceline.speed.geometry.paths import Path, both_ways, distance_beside, path_ahead
from paceline.speed.methods import OnEstimate
from paceline.speed.refinement.keyframes import Keyframe, exposures
from paceline.speed.refinement.model_selection import RefinedMotion, refine
from paceline.speed.refinement.path_deviation import deviation_of, heading_innovation
from paceline.speed.refinement.point_fit import second_estimate
from paceline.speed.refinement.self_calibration import RigEstimate
from paceline.speed.refinement.speed_interval import SpeedInterval, random_half_width
from paceline.speed.refinement.trajectory import Trajectory
from paceline.speed.results import Measurement, RigInformation, Synchronisation, Track
from paceline.units import COVERAGE_95
from paceline.verdicts import Message, message, plural

CROP_MARGIN = (0.6, 24.0)  # margin around a region, as a share of its size and in px
HEADING_GATE_SIGMA = 4.0  # standard deviations between the directions of a vehicle and of its drawn curve
MAX_PATH_DISTANCE_M = 15.0  # greatest distance between a vehicle and its path


class VehicleMeasurement:
    """One vehicle of a clip, frame by frame."""

    def __init__(
        self,
        clip: Clip,
        vehicle: VehicleDocument,
        drawn: dict[str, Path],
        configuration: SpeedConfiguration,
        batch: TrackerBatch,
        on_estimate: OnEstimate | None = None,
    ) -> None:
        self.batch, self.on_estimate = batch, on_estimate
        self.rig, self.vehicle, self.configuration = clip.rig, vehicle, configuration
        self.offset = clip.offset
        self.limits = configuration.limits
        drawn_path = drawn.get(vehicle.path) if vehicle.path is not None else None
        self.path = None if drawn_path is None else _path_beside(clip, vehicle, drawn_path, configuration)
        offset = clip.paths[self.path.name].lateral_offset if self.path is not None else 0.0
        self.tracker = batch.add(Tracker(clip.rig, vehicle, self.path, offset, configuration, batch.device))
        self.estimates: list[Estimate] = []
        self.keyframes: list[Keyframe] = []
        self._stride = 1  # frames from one keyframe to the next
        self._has_drawn_path = drawn_path is not None
        self._is_off_path = False  # whether the vehicle does not drive along its drawn path
        self._last_is_extra = False  # whether the last keyframe is beside this stride

    def process(self, frame: StereoFrame) -> bool:
        """Track the vehicle into ``frame``; False where the track ends."""
        estimate = self.batch.update(self.tracker, frame)
        self.estimates.append(estimate)
        if self.on_estimate is not None:
            self.on_estimate(self.vehicle.id, estimate)
        if (
            estimate.status == "tracking"
            and estimate.similarity >= MIN_VISIBLE_SIMILARITY
            and self.configuration.refine
        ):
            self._add_keyframe(frame, estimate)
        return estimate.status == "tracking"

    def _add_keyframe(self, frame: StereoFrame, estimate: Estimate) -> None:
        """Keep evenly spread frames, and the last one, at which the mean speed ends."""
        quads = np.stack([estimate.left, estimate.right])
        crops, origins = zip(*(_crop(i, q) for i, q in zip((frame.left, frame.right), quads, strict=True)), strict=True)
        half = 0.5 * frame.skew
        times = (frame.time - half, frame.time + half)
        if self._last_is_extra:
            self.keyframes.pop()
        self.keyframes.append(Keyframe(frame.index, times, crops, np.stack(origins), quads))
        self._last_is_extra = (len(self.estimates) - 1) % self._stride > 0
        if len(self.keyframes) > self.configuration.refinement.max_keyframes and not self._last_is_extra:
            self.keyframes, self._stride = self.keyframes[::2], 2 * self._stride

    def result(self) -> Measurement:
        """The measurement, refined unless the configuration or the track forbids it."""
        self.estimates = _lost_after_occlusion(self.estimates)
        tracked = [e for e in self.estimates if e.status == "tracking"]
        last = self.estimates[-1].status if self.estimates else "tracking"
        if too_few := acceptance.check_frames(last, len(tracked), self.limits):
            return self._rejected(too_few)
        if (n_similar := sum(e.similarity >= MIN_REFERENCE_SIMILARITY for e in tracked)) < self.limits.min_frames:
            return self._rejected(
                message(
                    "appearance_lost_from_start",
                    similar=n_similar,
                    frames=len(tracked),
                    min_frames=self.limits.min_frames,
                )
            )
        if not self.configuration.refine:
            return self._from_filter(tracked)
        try:
            refined = self._refined()
            while (count := acceptance.frames_to_refit(refined, self.limits)) < len(self.keyframes):
                if count < self.limits.min_frames:
                    break
                self.keyframes = self.keyframes[:count]
                self.estimates = _lost_after(self.estimates, self.keyframes[-1].frame)
                refined = self._refined()
        except np.linalg.LinAlgError:
            return self._rejected(message("too_little_texture", test="the equations of its motion are singular"))
        return self._measured(refined)

    def _refined(self) -> RefinedMotion:
        """The refined motion. The direction along the path was chosen from few frames, which may be too near to each
        other to tell it: a negative speed means the other direction, unless that gives a negative one, too."""
        speed = float(np.mean([e.speed for e in self.estimates[1:] if e.status == "tracking"]))
        drawn = self._drawn_path()
        self._is_off_path = self._has_drawn_path and drawn is None
        refined = self._refine_from(speed, drawn)
        if drawn is not None:
            (other,) = (path for path in self.tracker.candidate_paths if path is not drawn)
            for path in (other, drawn):
                if (backward := refined.mean_speed()[0]) < 0:
                    refined = self._refine_from(-backward, path)
        return refined

    def _refine_from(self, speed: float, drawn: Path | None) -> RefinedMotion:
        min_log_odds = self.configuration.model.min_log_odds
        refined = refine(self._trajectory(speed, drawn), self.keyframes, speed, drawn is not None, min_log_odds)
        return refined.of_outlines(self.vehicle.right, self.configuration.click_sigma)

    @property
    def _places(self) -> Array:
        """The places (N, 3) at which the filter has tracked the vehicle."""
        return np.array([e.position for e in self.estimates if e.status == "tracking"])

    def _drawn_path(self) -> Path | None:
        """The drawn path in the direction of travel, in which the filter's particles or, on a curve, its places go.

        None where they do not go along that curve at all.
        """
        path = self.tracker.path
        if path is None or path.shape == "line":
            return path
        places = self._places
        travel, middle = travel_along(places), places.mean(0)
        ahead = path_ahead(self.tracker.candidate_paths, middle, travel)
        if is_heading_known(places[-1] - places[0]):
            arc, _ = fit_arc(self.vehicle.id, places)
            if heading_innovation(arc, middle, ahead, self.configuration.driver) > HEADING_GATE_SIGMA:
                return None
        return ahead

    def _trajectory(self, speed: float, drawn: Path | None) -> Trajectory:
        """The outline's motion model: along a drawn line, else on an arc through the filter's places."""
        if drawn is not None and drawn.shape == "line":
            path, on_curve, curvature_mean = drawn, None, 0.0
        else:
            path, curvature = fit_arc(self.vehicle.id, self._places, drawn)
            on_curve, curvature_mean = drawn, 0.0 if drawn else -curvature
        if self.vehicle.plane == "free":
            plane = plane_across(self.tracker.plane, path.direction_near(self.tracker.plane.centre))
        else:
            plane = plane_from_outlines(self.rig, self.vehicle, path, self.configuration.click_sigma)
        frame_times = np.array([np.mean(k.times) for k in self.keyframes])
        times, timing, readouts = exposures(self.keyframes, self.rig, self.offset)
        outlined = times[0, 0]  # when the left view shows the outline
        times, frame_times = times - outlined, frame_times - outlined
        driver = self.configuration.driver
        deviation = deviation_of(path, plane, times, speed, drawn is not None, driver, on_curve)
        return Trajectory(
            self.rig,
            self.vehicle.left,
            plane,
            path,
            times,
            deviation,
            frame_times,
            timing,
            readouts,
            driver,
            curvature_mean,
        )

    def _measured(self, refined: RefinedMotion) -> Measurement:
        interval = SpeedInterval.of(refined)
        reason = (
            acceptance.check_surface(refined, self.keyframes, self.path)
            or acceptance.check_refined(refined, interval.speed, interval.half_width, self.limits)
            or acceptance.check_outline(refined, self.vehicle.right, self.configuration.click_sigma, self.limits)
            or acceptance.check_motion(refined)
        )
        second = None if reason else second_estimate(refined, self.keyframes)
        if second is not None:
            reason = acceptance.check_second_estimate(second, interval.half_width)
            if not reason:
                refined = second.combined_with(refined)
                interval = SpeedInterval.of(refined)
        fit = refined.rig_estimate
        rig_information = None if reason or fit is None else self._rig_information(refined, fit)
        reason = reason or acceptance.check_interval(
            interval.speed, interval.half_width, interval.random_half_width, self.limits
        )
        speeds, times = refined.speeds()[0], refined.trajectory.frame_times
        acceleration = float((speeds[-1] - speeds[0]) / (times[-1] - times[0]))
        terms = refined.motion_terms
        accelerating = {"acceleration", "varying_acceleration"} & {*terms}
        model = "constant acceleration" if accelerating else "constant speed"
        model = "changing acceleration" if "varying_acceleration" in terms else model
        model += ", turning" * ("curvature" in terms) + ", swerving" * ("lane_change" in terms)
        track = self._track(refined)
        return Measurement(
            vehicle=self.vehicle.id,
            track=track,
            speed=interval.speed,
            speed_lo=interval.speed - interval.half_width,
            speed_hi=interval.speed + interval.half_width,
            random_std=interval.random_std,
            systematic_std=interval.systematic_std,
            frames=int(track.counted.sum()),
            verdict="rejected" if reason else "measured",
            reason=str(reason),
            reason_code=reason.code,
            model=model,
            acceleration=acceleration if accelerating else float("nan"),
            residual_rms=refined.residual_rms,
            outline_offset=float(np.sqrt(np.nanmean(refined.offsets**2))),
            corners_difference=float("nan") if second is None else second.difference,
            corners_difference_std=float("nan") if second is None else second.difference_std,
            notices=self._notices(refined),
            calibrated_by=int(fit is not None),
            rig_information=rig_information,
        )

    def _rig_information(self, refined: RefinedMotion, fit: RigEstimate) -> RigInformation:
        """What the images determine of the rig."""
        mean, gradients = refined.trajectory.mean_speed_gradient, refined.trajectory.speed_jacobian
        of_images = refined.covariance_given_rig + refined.matching_covariance
        noise, model = (float(np.sqrt(mean @ C @ mean)) for C in (of_images, refined.model_covariance))
        model = float(np.hypot(model, refined.reference_std))
        variances = np.einsum("fi,ij,fj->f", gradients, of_images + refined.model_covariance, gradients)
        return RigInformation(
            offset=fit.offset,
            information=fit.information,
            mean_speed_gradient=mean @ fit.response,
            mean_speed_std=float(np.hypot(noise, model)),
            half_width=random_half_width(noise, model, refined.noise_dof(refined.covariance_given_rig)),
            speed_jacobian=self._by_row(gradients @ fit.response),
            speed_stds=self._by_row(np.sqrt(variances + refined.reference_variances)),
            exposure_stds=refined.trajectory.timing.stds,
            synchronisation=self._synchronisation(refined),
        )

    def _synchronisation(self, refined: RefinedMotion) -> Synchronisation | None:
        """What it means for the offset between the views that both cameras may be triggered together.

        If they are not, it is anywhere within half a frame interval.
        """
        stds = refined.trajectory.timing.stds
        if self.offset is None or self.offset.source == "stated" or "offset" not in stds:
            return None
        direction = len(refined.rig_shift_sigma) - len(stds) + list(stds).index("offset")
        interval = float(np.median(np.diff([e.time for e in self.estimates])))
        return Synchronisation(direction, -self.offset.value / stds["offset"], stds["offset"] / interval)

    def _by_row(self, fitted: Array) -> Array:
        """``fitted`` (F, …) at the keyframes, by the rows of the track: NaN at other frames."""
        rows = np.full((len(self.estimates), *fitted.shape[1:]), np.nan)
        keyframe_index = {k.frame: i for i, k in enumerate(self.keyframes)}
        for row, e in enumerate(self.estimates):
            if e.frame in keyframe_index:
                rows[row] = fitted[keyframe_index[e.frame]]
        return rows

    def _notices(self, refined: RefinedMotion) -> list[str]:
        notices: list[str] = []
        if self.rig.uncertainty is not None and self.rig.uncertainty.is_assumed:
            notices.append(message("rig_uncertainty_missing", rig="rig.yaml"))
        if self._is_off_path:
            notices.append(message("path_not_followed", path=self.vehicle.path))
        if any(beside := refined.reference.beside):
            left, right = beside
            sides = "both sides" if left and right else "the left" if left else "the right"
            notices.append(message("outline_beside_vehicle", share=left + right, side=sides))
        hidden = sum(e.similarity < MIN_REFERENCE_SIMILARITY for e in self.estimates)
        if hidden:
            notices.append(message("occluded_frames", frames=plural(hidden, "frame")))
        if lost_frames := [e.frame for e in self.estimates if e.status == "lost"]:
            notices.append(message("lost_at_frame", frame=lost_frames[0]))
        return notices

    def _from_filter(self, tracked: list[Estimate]) -> Measurement:
        """Without refinement: the filter's speeds, weighted by their information."""
        speeds = np.array([e.speed for e in tracked[1:]])
        information = 1.0 / np.array([e.speed_std for e in tracked[1:]]) ** 2
        speed, std = float(np.average(speeds, weights=information)), float(1.0 / np.sqrt(information.mean()))
        half_width = COVERAGE_95 * std
        reason = acceptance.check_interval(speed, half_width, limits=self.limits)
        return Measurement(
            vehicle=self.vehicle.id,
            track=self._track(None),
            speed=speed,
            speed_lo=speed - half_width,
            speed_hi=speed + half_width,
            random_std=std,
            systematic_std=float("nan"),
            frames=len(tracked),
            verdict="rejected" if reason else "measured",
            reason=str(reason),
            reason_code=reason.code,
            model="filter",
            notices=[message("not_refined")],
        )

    def _rejected(self, reason: Message) -> Measurement:
        nan = float("nan")
        frames = sum(e.status == "tracking" for e in self.estimates)
        speeds = nan, nan, nan, nan, nan
        rejected = Measurement(self.vehicle.id, self._track(None), *speeds, frames, "rejected", "", "none")
        return rejected.with_verdict(reason)

    def _track(self, refined: RefinedMotion | None) -> Track:
        E = self.estimates
        refined_speed, refined_std = np.full(len(E), np.nan), np.full(len(E), np.nan)
        hidden = np.array([e.similarity < MIN_VISIBLE_SIMILARITY for e in E], bool)
        if refined is not None:
            refined_speed, refined_std = (self._by_row(values) for values in refined.speeds())
            consistent = acceptance.consistent_frames(refined, self.limits)
            unlike = [k.frame for k, fits in zip(self.keyframes, consistent.tolist(), strict=True) if not fits]
            hidden |= np.isin([e.frame for e in E], unlike)
        return Track(
            vehicle=self.vehicle.id,
            frame=np.array([e.frame for e in E], np.int64),
            time=np.array([e.time for e in E]),
            speed=np.array([e.speed for e in E]),
            speed_std=np.array([e.speed_std for e in E]),
            position=np.array([e.position for e in E]).reshape(-1, 3),
            yaw_rate=np.array([e.yaw_rate for e in E]),
            left=np.array([e.left for e in E]).reshape(-1, 4, 2),
            right=np.array([e.right for e in E]).reshape(-1, 4, 2),
            ess=np.array([e.ess for e in E]),
            status=[e.status for e in E],
            particles_left=np.array([e.particles_left for e in E]),
            particles_right=np.array([e.particles_right for e in E]),
            refined_speed=refined_speed,
            refined_std=refined_std,
            hidden=hidden & np.array([e.status == "tracking" for e in E], bool),
        )


def _path_beside(clip: Clip, vehicle: VehicleDocument, path: Path, configuration: SpeedConfiguration) -> Path | None:
    """The drawn ``path``, if it passes next to a ``vehicle``; None where it is not known there.

    Raises UnusableInput where it is known and elsewhere.
    """
    centre = plane_from_outlines(clip.rig, vehicle, path, configuration.click_sigma).centre
    distance, is_known = distance_beside(both_ways(path, clip.paths[path.name].lateral_offset), centre)
    if distance < MAX_PATH_DISTANCE_M:
        return path
    if not is_known:
        return None
    raise UnusableInput(
        f"{clip.path}: paths.{path.name}: passes {distance:.0f} m beside vehicle {vehicle.id}; "
        "expected a line along which it drives, and lateral_offset in metres"
    )


def _lost_after_occlusion(estimates: list[Estimate]) -> list[Estimate]:
    """``estimates`` with those ``lost`` that come after the last frame in which the vehicle was visible."""
    visible_frames = [e.frame for e in estimates if e.status == "tracking" and e.similarity >= MIN_VISIBLE_SIMILARITY]
    return _lost_after(estimates, max(visible_frames, default=-1))


def _lost_after(estimates: list[Estimate], frame: int) -> list[Estimate]:
    """``estimates`` with those after ``frame`` marked as ``lost``."""
    return [replace(e, status="lost") if e.frame > frame and e.status == "tracking" else e for e in estimates]


def _crop(image: NDArray[np.float32], quad: Array) -> tuple[NDArray[np.float32], Array]:
    """The image around ``quad`` (4, 2) px with a margin, and its first pixel (2,)."""
    low, high = quad.min(0), quad.max(0)
    margin = CROP_MARGIN[0] * (high - low).max() + CROP_MARGIN[1]
    x0, y0 = np.maximum(np.floor(low - margin), 0).astype(int)
    x1, y1 = np.ceil(high + margin).astype(int)
    return image[y0:y1, x0:x1].copy(), np.array([x0, y0], float)
