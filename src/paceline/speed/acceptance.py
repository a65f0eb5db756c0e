"""Acceptance tests of a refined motion: image residuals of every frame, the calibration, the interval's width.

They return the code of a rejection; its text and advice are in `paceline.verdicts`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from paceline.speed.configuration import DEFAULT_LIMITS, Limits
from paceline.speed.geometry.paths import Path
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.model_selection import RefinedMotion
from paceline.speed.refinement.point_fit import SecondEstimate
from paceline.speed.refinement.road_hypothesis import log_likelihood_ratio_of_road
from paceline.speed.results import Measurement
from paceline.verdicts import NO_REASON, Message, message

MAX_DEVIATION_SIGMA = 3.0  # RMS deviation from the path where the contrast is lower than the next constant
MIN_TRACK_CONTRAST_GREY = 5.0  # grey levels; below, the background may have been followed instead

FULL_BRAKING_MPS2, FULL_THROTTLE_MPS2 = 9.0, 6.0  # at the limits of tyres and engines
FULL_TURNING_MPS2 = 9.81  # sideways, with a friction coefficient of 1
MAX_DISAGREEMENT_CHANCE = 0.005  # probability that both estimates of a right speed differ by more than is accepted
MIN_OUTLINE_FRAMES = 2  # first frames of which one has to show the vehicle where the motion puts it
MAX_STANDING_TRAVEL_M = 0.3  # in the whole track, of what is taken to stand still
MAX_LOG_RATIO_OF_ROAD = 5.0  # log likelihood ratio of the road over a vehicle: prior odds of 150 to 1 for the vehicle
CERTAINTY_SIGMA = 1.645  # standard deviations beyond a limit at which it is exceeded with a probability of 95 %


def check_refined(refined: RefinedMotion, speed: float, half_width: float, limits: Limits = DEFAULT_LIMITS) -> Message:
    """The reason to reject ``speed`` (m/s) with its half-width ``half_width``; empty where all tests pass.

    `check_surface`, `check_outline`, `check_second_estimate` and `check_interval` are applied apart.
    """
    if not np.isfinite([speed, half_width]).all():
        return message("no_motion_fits", test="the fitted speed is not a finite number")
    if reason := check_residuals(refined, limits):
        return reason
    epipolar_offset = float(np.nanmedian(refined.offsets[:, 1, 1] - refined.offsets[:, 0, 1]))
    if abs(epipolar_offset) > limits.epipolar_offset_px:
        return message("views_disagree", offset_px=abs(epipolar_offset), max_offset_px=limits.epipolar_offset_px)
    if (shift := float(np.abs(refined.rig_shift_sigma).max(initial=0.0))) > limits.rig_shift_sigma:
        return message("calibration_inconsistent", deviation=shift, max_deviation=limits.rig_shift_sigma)
    if not 0 <= speed <= limits.max_speed:
        return message("speed_implausible", speed_mps=speed, max_speed_mps=limits.max_speed)
    if refined.deviation_sigma > MAX_DEVIATION_SIGMA and refined.contrast < MIN_TRACK_CONTRAST_GREY:
        return message(
            "path_deviation_implausible",
            deviation=refined.deviation_sigma,
            max_deviation=MAX_DEVIATION_SIGMA,
            contrast=refined.contrast,
            min_contrast=MIN_TRACK_CONTRAST_GREY,
        )
    return NO_REASON


def check_outline(
    refined: RefinedMotion, right: NDArray[np.float64], click_sigma: float, limits: Limits = DEFAULT_LIMITS
) -> Message:
    """The reason to reject a motion that is not at the outline ``right`` (4, 2) px of the first frame; else empty.

    Corners have a standard deviation of ``click_sigma`` px, or of their own scatter where that is larger. The motion
    starts from the left outline by construction. Both views of an occluder are consistent with each other, too, but at
    another distance than the two outlines.
    """
    residuals = refined.trajectory.quads(refined.theta)[0, 1] - right
    mean = residuals.mean(0)
    scatter = float(np.sqrt(((residuals - mean) ** 2).sum() / (residuals.size - mean.size)))
    offset = float(np.linalg.norm(mean))
    limit = limits.outline_sigma * max(float(np.sqrt(2.0)) * click_sigma, scatter) / float(np.sqrt(len(residuals)))
    if offset <= limit:
        return NO_REASON
    return message("outline_inconsistent", offset_px=offset, max_offset_px=limit)


def check_motion(refined: RefinedMotion) -> Message:
    """The reason to reject a motion that no vehicle makes, with a probability of 95 %; else empty."""
    (along, across), (along_std, across_std) = (values.T for values in refined.accelerations())
    for motion, value, std, limit in (
        ("brakes", -along, along_std, FULL_BRAKING_MPS2),
        ("gathers speed", along, along_std, FULL_THROTTLE_MPS2),
        ("turns", across, across_std, FULL_TURNING_MPS2),
    ):
        least = float(np.max(value - CERTAINTY_SIGMA * std))
        if least > limit:
            return message("motion_implausible", motion=motion, acceleration=least, max_acceleration=limit)
    return NO_REASON


def check_surface(refined: RefinedMotion, keyframes: Sequence[Keyframe], path: Path | None) -> Message:
    """The reason to reject what stands still, seen in ``keyframes``, where it is the road under a ``path`` and no
    vehicle; else empty."""
    times = refined.trajectory.frame_times
    travel = abs(refined.mean_speed()[0]) * float(times[-1] - times[0])
    if path is None or not travel <= MAX_STANDING_TRAVEL_M:
        return NO_REASON
    log_ratio = log_likelihood_ratio_of_road(refined, keyframes, path)
    if log_ratio <= MAX_LOG_RATIO_OF_ROAD:
        return NO_REASON
    return message("on_the_road_surface", log_ratio=log_ratio, max_log_ratio=MAX_LOG_RATIO_OF_ROAD)


def check_second_estimate(second: SecondEstimate, half_width: float) -> Message:
    """The reason to reject a speed with its half-width ``half_width`` (m/s) from which the ``second`` estimate differs
    by more than that, and by more than both covariances allow; else empty."""
    chance = 1.0 - MAX_DISAGREEMENT_CHANCE / 2
    limit = max(half_width, float(stdtrit(second.difference_dof, chance)) * second.difference_std)
    if not abs(second.difference) > limit:
        return NO_REASON
    return message(
        "methods_disagree",
        corners_mps=second.speed,
        grey_values_mps=second.speed - second.difference,
        difference_mps=abs(second.difference),
        max_difference_mps=limit,
    )


def consistent_frames(refined: RefinedMotion, limits: Limits = DEFAULT_LIMITS) -> NDArray[np.bool_]:
    """Frames (F,) of which all views that were used fit the motion."""
    compared = np.isfinite(refined.explained_share)
    fits = (refined.explained_share >= 1.0 - limits.unexplained_contrast**2) & (
        np.linalg.norm(refined.offsets, axis=-1) <= limits.image_offset_px
    )
    return np.asarray(compared.any(1) & (fits | ~compared).all(1))


def check_residuals(refined: RefinedMotion, limits: Limits = DEFAULT_LIMITS) -> Message:
    """The reason to reject a motion that the images do not fit; empty where they do."""
    offset = float(np.sqrt(np.nanmean(refined.offsets**2)))
    if not refined.converged:
        return message("no_motion_fits", test="the fit did not converge")
    if refined.residual_rms > limits.unexplained_contrast * refined.contrast or offset > limits.image_offset_px:
        unexplained = refined.residual_rms / max(refined.contrast, 1e-9)
        return message(
            "image_residual_too_large",
            offset_px=offset,
            max_offset_px=limits.image_offset_px,
            unexplained=unexplained,
            max_unexplained=limits.unexplained_contrast,
        )
    consistent = consistent_frames(refined, limits)
    count, frames = consistent.sum(), len(consistent)
    if consistent.mean() < limits.consistent_share or count < limits.min_frames:
        return message(
            "too_few_consistent_frames",
            consistent=count,
            frames=frames,
            min_share=limits.consistent_share,
            min_frames=limits.min_frames,
        )
    # the distance is counted from the outline: an occluder's motion, or one that only a later part of the track fits
    if not consistent[:MIN_OUTLINE_FRAMES].any():
        return message("first_frames_inconsistent", frames=MIN_OUTLINE_FRAMES)
    return NO_REASON


def frames_to_refit(refined: RefinedMotion, limits: Limits = DEFAULT_LIMITS) -> int:
    """How many of the first frames to fit next: up to an occlusion, all where there is none.

    Half of them where no motion fits, as the occlusion may have begun early.
    """
    consistent = consistent_frames(refined, limits)
    if limits.min_frames <= (count := frames_before_occlusion(consistent)) < len(consistent):
        return count
    return len(consistent) // 2 if check_residuals(refined, limits) else len(consistent)


def frames_before_occlusion(consistent: NDArray[np.bool_]) -> int:
    """The number of frames before an occlusion: after them most frames are not ``consistent`` (F,).

    The filter may have followed the occluder there.
    """
    balance = np.cumsum(np.where(consistent, 1, -1))
    return len(consistent) - int(np.argmax(balance[::-1]))


def check_frames(status: str, frames: int, limits: Limits = DEFAULT_LIMITS) -> Message:
    """The reason to reject a track of so many ``frames``, its last ``status`` that, as too short; else empty."""
    if frames >= limits.min_frames:
        return NO_REASON
    if status == "ended":
        return message("left_image_early", frames=frames, min_frames=limits.min_frames)
    return message("lost_early" if status == "lost" else "seen_briefly", frames=frames, min_frames=limits.min_frames)


def check_interval(speed: float, half_width: float, random: float = 0.0, limits: Limits = DEFAULT_LIMITS) -> Message:
    """The reason to reject an interval, else empty.

    ``half_width`` is that of the whole interval and ``random`` that without the calibration's part, both m/s.
    """
    for width, share, only_random in ((half_width, 1.0, False), (random, limits.max_random_share, True)):
        if width > (limit := share * max(limits.max_half_width * speed, limits.max_half_width_mps)):
            positive = max(speed, 1e-9)
            if width / positive >= 1:
                return message("speed_unknown", half_width_mps=width, speed_mps=speed, max_half_width_mps=limit)
            return message(
                "interval_too_wide_random" if only_random else "interval_too_wide",
                relative=width / positive,
                max_relative=limit / positive,
            )
    return NO_REASON


def apply_tolerance(m: Measurement, tolerance: float | None) -> Measurement:
    """``m``, rejected if its 95 % interval is wider than ± ``tolerance`` (m/s), which the user states."""
    if tolerance is None or m.verdict != "measured" or (half_width := (m.speed_hi - m.speed_lo) / 2) <= tolerance:
        return m
    return m.with_verdict(
        message("tolerance_exceeded", half_width_mps=half_width, ratio=half_width / tolerance, tolerance_mps=tolerance)
    )
