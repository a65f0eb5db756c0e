"""The result of every baseline: a track, a mean speed with its interval, and a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import stdtrit

from paceline.arrays import Array
from paceline.baselines.template_tracking import TemplateTracker
from paceline.recordings.stereo import StereoFrame
from paceline.speed.acceptance import check_frames, check_interval
from paceline.speed.configuration import Limits
from paceline.speed.results import CONFIDENCE_LEVEL, Measurement, Track
from paceline.verdicts import Message, message

NAN = float("nan")
NOISE_STEP_S = 0.2  # time step to which the noises of the configuration refer


@dataclass(frozen=True, eq=False)
class FrameResult:
    """A vehicle at one frame (SI units, ideal pixels); NaN where the method gives no value.

    ``status`` is tracking, lost (not seen in this frame; it may be seen again) or ended (out of an image).
    ``points_left`` and ``points_right`` (n, 2) are the features or particles that the overlay shows,
    ``effective_points`` the number of matched features, or the effective sample size of the particles.
    """

    frame: int
    time: float
    left: Array  # (4, 2)
    right: Array  # (4, 2)
    status: str = "tracking"
    speed: float = NAN
    speed_std: float = NAN
    position: Array = field(default_factory=lambda: np.full(3, NAN))
    points_left: Array = field(default_factory=lambda: np.empty((0, 2)))
    points_right: Array = field(default_factory=lambda: np.empty((0, 2)))
    effective_points: float = NAN


@dataclass(frozen=True, eq=False)
class MeanSpeed:
    """A mean speed over the frames measured, m/s, with its standard uncertainty from scatter, known from ``dof``
    degrees of freedom; ``speeds`` and ``stds`` (N,) are the smoothed speeds at the track's frames, where there are
    any."""

    speed: float
    std: float
    dof: float
    model: str
    speeds: Array | None = None
    stds: Array | None = None


def measurement_of_filter(vehicle: str, results: Sequence[FrameResult], model: str, limits: Limits) -> Measurement:
    """The measurement from a filter's own speeds: their mean, weighted by inverse variances.

    A filter's successive estimates repeat one another's errors, so that their scatter is not divided by their number.
    """
    known = [s for s in results if s.status == "tracking" and np.isfinite(s.speed_std)]
    speeds, stds = (np.array([getattr(s, name) for s in known]) for name in ("speed", "speed_std"))
    information = (
        np.maximum(stds, np.median(stds)) ** -2.0
    )  # particles that have collapsed to a point carry no more information
    mean = float(np.average(speeds, weights=information))
    scatter = float(np.average((speeds - mean) ** 2, weights=information))
    std = float(np.sqrt(scatter + 1.0 / information.mean()))
    return measurement_of(vehicle, results, MeanSpeed(mean, std, len(known) - 1.0, model), limits)


def measurement_of(vehicle: str, results: Sequence[FrameResult], mean: MeanSpeed, limits: Limits) -> Measurement:
    """The measurement of a vehicle; rejected, with the reason, where its speed or interval fails the limits."""
    half = float(stdtrit(mean.dof, 0.5 + CONFIDENCE_LEVEL / 2) * mean.std)
    if not np.isfinite([mean.speed, half]).all():
        reason = message("no_motion_fits", test="the fitted speed is not a finite number")
    elif mean.speed > limits.max_speed:
        reason = message("speed_implausible", speed_mps=mean.speed, max_speed_mps=limits.max_speed)
    else:
        reason = check_interval(mean.speed, half, limits=limits)
    return Measurement(
        vehicle=vehicle,
        track=track_of(vehicle, results, mean.speeds, mean.stds),
        speed=mean.speed,
        speed_lo=mean.speed - half,
        speed_hi=mean.speed + half,
        random_std=mean.std,
        systematic_std=NAN,
        frames=_tracked_frames(results),
        verdict="rejected" if reason else "measured",
        reason=str(reason),
        reason_code=reason.code,
        model=mean.model,
        notices=[message("baseline_interval")],
    )


def unseen_frame(frame: StereoFrame, regions: TemplateTracker) -> FrameResult:
    """The result of a frame in which the vehicle is not found: the regions stay where they were."""
    status = "ended" if regions.status == "ended" else "lost"
    return FrameResult(frame.index, frame.time, regions.quads[0], regions.quads[1], status=status)


def rejected(vehicle: str, results: Sequence[FrameResult], reason: Message) -> Measurement:
    """A rejected measurement without a speed."""
    track, frames = track_of(vehicle, results), _tracked_frames(results)
    return Measurement(vehicle, track, NAN, NAN, NAN, NAN, NAN, frames, "rejected", "", "none").with_verdict(reason)


def check_frame_count(results: Sequence[FrameResult], limits: Limits) -> Message:
    """Why the track is too short to be measured; empty where it is not."""
    return check_frames(results[-1].status if results else "tracking", _tracked_frames(results), limits)


def track_of(
    vehicle: str, results: Sequence[FrameResult], speeds: Array | None = None, stds: Array | None = None
) -> Track:
    """The aligned arrays of a track; points are padded with NaN to the same number in every frame."""
    undefined = np.full(len(results), NAN)
    return Track(
        vehicle=vehicle,
        frame=np.array([s.frame for s in results], np.int64),
        time=np.array([s.time for s in results]),
        speed=np.array([s.speed for s in results]),
        speed_std=np.array([s.speed_std for s in results]),
        position=np.array([s.position for s in results]).reshape(-1, 3),
        yaw_rate=undefined,
        left=np.array([s.left for s in results]).reshape(-1, 4, 2),
        right=np.array([s.right for s in results]).reshape(-1, 4, 2),
        ess=np.array([s.effective_points for s in results]),
        status=[s.status for s in results],
        particles_left=_padded([s.points_left for s in results]),
        particles_right=_padded([s.points_right for s in results]),
        refined_speed=undefined if speeds is None else speeds,
        refined_std=undefined if stds is None else stds,
        hidden=np.zeros(len(results), bool),
    )


def _tracked_frames(results: Sequence[FrameResult]) -> int:
    return sum(s.status == "tracking" for s in results)


def _padded(points: Sequence[Array]) -> Array:
    max_count = max((len(p) for p in points), default=0)
    filled = np.full((len(points), max(max_count, 1), 2), NAN)
    for row, p in zip(filled, points, strict=True):
        row[: len(p)] = p
    return filled
