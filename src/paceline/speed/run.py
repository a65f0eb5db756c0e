"""One vehicle through a clip: tracked frame by frame, refined at the end, and judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from paceline.arrays import Array
from paceline.documents.loading import Clip, VehicleDocument
from paceline.errors import UnusableInput
from paceline.recordings.stereo import StereoFrame
from paceline.speed import verdict
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.batch import TrackerBatch
from paceline.speed.filter.estimate import Estimate
from paceline.speed.filter.tracker import MIN_REFERENCE_SIMILARITY, MIN_VISIBLE_SIMILARITY, Tracker
from paceline.speed.geometry import paths
from paceline.speed.geometry.initial_plane import plane_across, plane_from_outlines
from paceline.speed.geometry.paths import Path
from paceline.speed.refinement.keyframes import Glimpse
from paceline.speed.refinement.model_selection import RefinedMotion, refine
from paceline.speed.refinement.path_deviation import way_of
from paceline.speed.refinement.self_calibration import RigFit
from paceline.speed.refinement.trajectory import Trajectory
from paceline.speed.results import CONFIDENCE, Measurement, RigTold, Track
from paceline.verdicts import Message, message, plural

Seen = Callable[[str, Estimate], None]

MARGIN = (0.6, 24.0)  # kept about a region, as a share of its size and in pixels
BESIDE = 15.0  # m from a vehicle, beyond which a path is not the one it drives on


class VehicleRun:
    """One vehicle on its way through the clip."""

    def __init__(
        self,
        clip: Clip,
        vehicle: VehicleDocument,
        drawn: dict[str, Path],
        configuration: SpeedConfiguration,
        fleet: TrackerBatch,
        seen: Seen | None = None,
    ) -> None:
        self.fleet, self.seen = fleet, seen
        self.rig, self.vehicle, self.configuration = clip.rig, vehicle, configuration
        self.limits = configuration.limits
        on_path = vehicle.path if vehicle.path in drawn else None
        self.path = drawn[on_path] if on_path is not None else None
        offset = clip.paths[on_path].lateral_offset if on_path is not None else 0.0
        self.tracker = fleet.join(Tracker(clip.rig, vehicle, self.path, offset, configuration, fleet.device))
        if self.path is not None:
            centre = self.tracker.plane.centre
            nearest = [way.at(np.array(way.nearest(centre))) for way in self.tracker.ways]
            beside = min(float(np.linalg.norm(place - centre)) for place in nearest)
            if not beside < BESIDE:
                raise UnusableInput(
                    f"{clip.path}: paths.{on_path}: passes {beside:.0f} m beside vehicle {vehicle.id}; "
                    "expected a line along which it drives, and lateral_offset in metres"
                )
        self.estimates: list[Estimate] = []
        self.glimpses: list[Glimpse] = []
        self._stride, self._passing = 1, False  # frames from one kept to the next; whether the last one is beside these

    def see(self, frame: StereoFrame) -> bool:
        """Follow the vehicle into ``frame``; whether it can be followed further."""
        estimate = self.fleet.update(self.tracker, frame)
        self.estimates.append(estimate)
        if self.seen is not None:
            self.seen(self.vehicle.id, estimate)
        if (
            estimate.status == "tracking"
            and estimate.similarity >= MIN_VISIBLE_SIMILARITY
            and self.configuration.refine
        ):
            self._keep(frame, estimate)
        return estimate.status == "tracking"

    def _keep(self, frame: StereoFrame, estimate: Estimate) -> None:
        """Keep what evenly spread frames show, and the last one, to which the mean speed is counted."""
        quads = np.stack([estimate.left, estimate.right])
        crops, corners = zip(*(_crop(i, q) for i, q in zip((frame.left, frame.right), quads, strict=True)), strict=True)
        half = 0.5 * frame.skew
        times = (frame.time - half, frame.time + half)
        if self._passing:
            self.glimpses.pop()
        self.glimpses.append(Glimpse(frame.index, times, crops, np.stack(corners), quads))
        self._passing = (len(self.estimates) - 1) % self._stride > 0
        if len(self.glimpses) > self.configuration.refinement.max_keyframes and not self._passing:
            self.glimpses, self._stride = self.glimpses[::2], 2 * self._stride

    def result(self) -> Measurement:
        """The measurement, refined where enough was seen."""
        self.estimates = _until_hidden(self.estimates)
        tracked = [e for e in self.estimates if e.status == "tracking"]
        last = self.estimates[-1].status if self.estimates else "tracking"
        if few := verdict.check_frames(last, len(tracked), self.limits):
            return self._rejected(few)
        if (seen := sum(e.similarity >= MIN_REFERENCE_SIMILARITY for e in tracked)) < self.limits.min_frames:
            return self._rejected(
                message(
                    "appearance_lost_from_start", similar=seen, frames=len(tracked), min_frames=self.limits.min_frames
                )
            )
        if not self.configuration.refine:
            return self._from_filter(tracked)
        try:
            refined = self._refined()
            while (
                self.limits.min_frames <= (kept := verdict.frames_to_refit(refined, self.limits)) < len(self.glimpses)
            ):
                self.glimpses = self.glimpses[:kept]
                self.estimates = _lost_after(self.estimates, self.glimpses[-1].frame)
                refined = self._refined()
        except np.linalg.LinAlgError:
            return self._rejected(message("too_little_texture", test="the equations of its motion are singular"))
        return self._judged(refined, sum(e.status == "tracking" for e in self.estimates))

    def _refined(self) -> RefinedMotion:
        speed = float(np.mean([e.speed for e in self.estimates[1:] if e.status == "tracking"]))
        return refine(self._trajectory(speed), self.glimpses, speed, self.path is not None)

    def _trajectory(self, speed: float) -> Trajectory:
        """The outline and the way it goes: the path in the sense of travel, or straight on as the filter saw it."""
        first = self.glimpses[0]
        path = self.tracker.path
        if path is None:
            places = np.array([e.position for e in self.estimates if e.status == "tracking"])
            path = paths.straight_path(self.vehicle.id, places)
        if self.vehicle.plane == "free":
            plane = plane_across(self.tracker.plane, path.frames(path.s[:1])[0, :, 0])
        else:
            plane = plane_from_outlines(self.rig, self.vehicle, path, self.configuration.click_sigma)
        times = np.array([g.times for g in self.glimpses]) - np.mean(first.times)
        way = way_of(path, plane, times, speed, self.path is not None)
        return Trajectory(self.rig, self.vehicle.left, plane, path, times, way)

    def _judged(self, refined: RefinedMotion, frames: int) -> Measurement:
        speed, noise_std, doubt_std, systematic_std = refined.mean_speed()
        random_std = float(np.hypot(noise_std, doubt_std))
        # the noise is judged by few frames and patches; the other two are what they are
        usual, wider = ndtri(0.5 + CONFIDENCE / 2), stdtrit(refined.dof, 0.5 + CONFIDENCE / 2)
        own = float(np.hypot(wider * noise_std, usual * doubt_std))
        half = float(np.hypot(own, usual * np.nan_to_num(systematic_std)))
        reason = verdict.check_refined(refined, speed, half, self.limits) or verdict.check_outline(
            refined, self.vehicle.right, self.configuration.click_sigma, self.limits
        )
        rig = None if reason or refined.rig_fit is None else self._told(refined, refined.rig_fit, wider)
        reason = reason or verdict.check_interval(speed, half, own, self.limits)
        speeds, times = refined.speeds()[0], refined.trajectory.times.mean(1)
        acceleration = float((speeds[-1] - speeds[0]) / (times[-1] - times[0]))
        accelerating = {"acceleration", "surge"} & {*refined.motion_terms}
        model = "constant acceleration" if accelerating else "constant speed"
        model = "changing acceleration" if "surge" in refined.motion_terms else model
        model += ", turning" * ("turn" in refined.motion_terms) + ", swerving" * ("swerve" in refined.motion_terms)
        return Measurement(
            vehicle=self.vehicle.id,
            track=self._track(refined),
            speed=speed,
            speed_lo=speed - half,
            speed_hi=speed + half,
            random_std=random_std,
            systematic_std=systematic_std,
            frames=frames,
            verdict="rejected" if reason else "measured",
            reason=str(reason),
            reason_code=reason.code,
            model=model,
            acceleration=acceleration if accelerating else float("nan"),
            residual_rms=refined.residual_rms,
            notices=self._notices(refined),
            calibrated_by=int(refined.rig_fit is not None),
            rig=rig,
        )

    def _told(self, refined: RefinedMotion, fit: RigFit, wider: float) -> RigTold:
        """What the fit tells of the rig, and its speeds if that were known; their noise is ``wider`` than it seems."""
        mean, shares = refined.trajectory.mean_speed_shares, refined.trajectory.speed_shares
        noise, doubt = (float(np.sqrt(mean @ C @ mean)) for C in (fit.covariance, refined.model_covariance))
        variances = np.einsum("fi,ij,fj->f", shares, fit.covariance + refined.model_covariance, shares)
        return RigTold(
            moves=fit.moves,
            information=fit.information,
            speed=mean @ fit.response,
            std=float(np.hypot(noise, doubt)),
            half=float(np.hypot(wider * noise, ndtri(0.5 + CONFIDENCE / 2) * doubt)),
            speeds=self._by_row(shares @ fit.response),
            stds=self._by_row(np.sqrt(variances)),
        )

    def _by_row(self, fitted: Array) -> Array:
        """What is ``fitted`` (F, …) at the frames that were kept, by the rows of the track: NaN at the others."""
        rows = np.full((len(self.estimates), *fitted.shape[1:]), np.nan)
        kept = {g.frame: i for i, g in enumerate(self.glimpses)}
        for row, e in enumerate(self.estimates):
            if e.frame in kept:
                rows[row] = fitted[kept[e.frame]]
        return rows

    def _notices(self, refined: RefinedMotion) -> list[str]:
        notices: list[str] = []
        if np.isnan(refined.systematic_covariance).any():
            consequence = "the interval holds no systematic part"
            notices.append(message("rig_uncertainty_missing", rig="rig.yaml", consequence=consequence))
        hidden = sum(e.similarity < MIN_REFERENCE_SIMILARITY for e in self.estimates)
        if hidden:
            notices.append(message("occluded_frames", frames=plural(hidden, "frame")))
        if lost := [e.frame for e in self.estimates if e.status == "lost"]:
            notices.append(message("lost_at_frame", frame=lost[0]))
        return notices

    def _from_filter(self, tracked: list[Estimate]) -> Measurement:
        """Without refinement: the filter's speeds, averaged by what they claim to know, and how much they do."""
        speeds = np.array([e.speed for e in tracked[1:]])
        information = 1.0 / np.array([e.speed_std for e in tracked[1:]]) ** 2
        speed, std = float(np.average(speeds, weights=information)), float(1.0 / np.sqrt(information.mean()))
        half = float(ndtri(0.5 + CONFIDENCE / 2)) * std
        reason = verdict.check_interval(speed, half, limits=self.limits)
        return Measurement(
            vehicle=self.vehicle.id,
            track=self._track(None),
            speed=speed,
            speed_lo=speed - half,
            speed_hi=speed + half,
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
        return Measurement(self.vehicle.id, self._track(None), *speeds, frames, "rejected", "", "none").judged(reason)

    def _track(self, refined: RefinedMotion | None) -> Track:
        E = self.estimates
        refined_speed, refined_std = np.full(len(E), np.nan), np.full(len(E), np.nan)
        if refined is not None:
            refined_speed, refined_std = (self._by_row(values) for values in refined.speeds())
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
        )


def _until_hidden(estimates: list[Estimate]) -> list[Estimate]:
    """``estimates`` with those ``lost`` that come after the last frame in which the vehicle was in view."""
    seen = [e.frame for e in estimates if e.status == "tracking" and e.similarity >= MIN_VISIBLE_SIMILARITY]
    return _lost_after(estimates, max(seen, default=-1))


def _lost_after(estimates: list[Estimate], frame: int) -> list[Estimate]:
    """``estimates`` with those ``lost`` that come after ``frame``: the mean speed is that of the frames before."""
    return [replace(e, status="lost") if e.frame > frame and e.status == "tracking" else e for e in estimates]


def _crop(image: NDArray[np.float32], quad: Array) -> tuple[NDArray[np.float32], Array]:
    """The picture about ``quad`` (4, 2) with a margin, and its first pixel (2,)."""
    low, high = quad.min(0), quad.max(0)
    margin = MARGIN[0] * (high - low).max() + MARGIN[1]
    x0, y0 = np.maximum(np.floor(low - margin), 0).astype(int)
    x1, y1 = np.ceil(high + margin).astype(int)
    return image[y0:y1, x0:x1].copy(), np.array([x0, y0], float)
