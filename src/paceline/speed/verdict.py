"""Acceptance tests of a refined motion: image residuals of every frame, the calibration, the interval's width."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from paceline.speed.refinement.model_selection import RefinedMotion
from paceline.speed.results import Measurement
from paceline.units import SpeedUnit

MIN_FRAMES = 4
MAX_UNEXPLAINED_CONTRAST = 0.6  # residual over the texture's contrast, both RMS
MAX_IMAGE_OFFSET_PX = 0.6  # RMS over the frames, between the images and where the fitted motion puts them
MIN_CONSISTENT_SHARE = 0.5  # of the frames
MAX_EPIPOLAR_OFFSET_PX = 1.0  # between the views, across the epipolar lines
MAX_SPEED_MPS = 90.0
MAX_DEVIATION_SIGMA = 3.0  # RMS deviation from the path where the contrast is lower than the next constant
MIN_CONTRAST_GREY = 5.0  # grey levels; below, the background may have been followed instead
MAX_OUTLINE_SIGMA = 5.0  # between the motion and the outline in the right view
MAX_RIG_SHIFT_SIGMA = 5.0  # between the rig that the images determine and the one that rig.yaml states
MAX_HALF_WIDTH = (0.06, SpeedUnit.KMH.mps)  # of the 95 % interval: relative and m/s, whichever is larger
MAX_RANDOM_SHARE = 2 / 3  # of MAX_HALF_WIDTH: the interval without the calibration's part
SPEED_UNKNOWN = "the speed is not known"


def check_refined(refined: RefinedMotion, speed: float, half_width: float) -> str:
    """The reason to reject ``speed`` (m/s) with its half-width ``half_width``; empty where all tests pass.

    `check_outline` and `check_interval` are applied apart.
    """
    if not np.isfinite([speed, half_width]).all():
        return "residuals: no motion explains the pictures"
    if reason := check_residuals(refined):
        return reason
    epipolar_offset = float(np.nanmedian(refined.offsets[:, 1, 1] - refined.offsets[:, 0, 1]))
    if abs(epipolar_offset) > MAX_EPIPOLAR_OFFSET_PX:
        return f"views disagree: they lie {abs(epipolar_offset):.1f} px apart across the epipolar lines"
    if (shift := float(np.abs(refined.rig_shift_sigma).max(initial=0.0))) > MAX_RIG_SHIFT_SIGMA:
        return (
            f"calibration: these pictures want the cameras elsewhere, by {shift:.1f} times as much as the uncertainty "
            "in rig.yaml makes usual"
        )
    if not 0 <= speed <= MAX_SPEED_MPS:
        return f"implausible: {speed:.1f} m/s"
    if refined.deviation_sigma > MAX_DEVIATION_SIGMA and refined.contrast < MIN_CONTRAST_GREY:
        return (
            f"implausible: its way bends {refined.deviation_sigma:.0f} times as much as is likely, "
            f"by a face of {refined.contrast:.1f} grey levels"
        )
    return ""


def check_outline(refined: RefinedMotion, right: NDArray[np.float64], click_sigma: float) -> str:
    """The reason to reject a motion that is not at the outline ``right`` (4, 2) px of the first frame; else empty.

    Corners have a standard deviation of ``click_sigma`` px, or of their own scatter where that is larger. The motion
    starts from the left outline by construction. Both views of an occluder are consistent with each other, too, but at
    another distance than the two outlines.
    """
    residuals = refined.trajectory.quads(refined.theta)[0, 1] - right
    mean = residuals.mean(0)
    scatter = float(np.sqrt(((residuals - mean) ** 2).sum() / (residuals.size - mean.size)))
    offset = float(np.linalg.norm(mean))
    limit = MAX_OUTLINE_SIGMA * max(float(np.sqrt(2.0)) * click_sigma, scatter) / float(np.sqrt(len(residuals)))
    if offset <= limit:
        return ""
    return f"outline: what the pictures show lies {offset:.1f} px off it in the right view, more than {limit:.1f}"


def consistent_frames(refined: RefinedMotion) -> NDArray[np.bool_]:
    """Frames (F,) of which all views that were used fit the motion."""
    used = np.isfinite(refined.explained_share)
    fits = (refined.explained_share >= 1.0 - MAX_UNEXPLAINED_CONTRAST**2) & (
        np.linalg.norm(refined.offsets, axis=-1) <= MAX_IMAGE_OFFSET_PX
    )
    return np.asarray(used.any(1) & (fits | ~used).all(1))


def check_residuals(refined: RefinedMotion) -> str:
    """The reason to reject a motion that the images do not fit; empty where they do."""
    offset = float(np.sqrt(np.nanmean(refined.offsets**2)))
    if not refined.converged:
        return "residuals: no motion explains the pictures"
    if refined.residual_rms > MAX_UNEXPLAINED_CONTRAST * refined.contrast or offset > MAX_IMAGE_OFFSET_PX:
        unexplained = refined.residual_rms / max(refined.contrast, 1e-9)
        return (
            f"residuals: the pictures lie {offset:.1f} px off the fitted motion and "
            f"{unexplained:.0%} of their contrast is unexplained"
        )
    consistent = consistent_frames(refined)
    count, frames = consistent.sum(), len(consistent)
    if consistent.mean() < MIN_CONSISTENT_SHARE or count < MIN_FRAMES:
        return f"residuals: only {count} of {frames} frames show the vehicle where the fitted motion puts it"
    if not consistent[:MIN_FRAMES].any():  # the motion is an occluder's that appeared later
        return f"residuals: none of the first {MIN_FRAMES} frames shows the vehicle where the fitted motion puts it"
    return ""


def frames_to_refit(refined: RefinedMotion) -> int:
    """How many of the first frames to fit next: up to an occlusion, all where there is none.

    Half of them where no motion fits, as the occlusion may have begun early.
    """
    consistent = consistent_frames(refined)
    if MIN_FRAMES <= (kept := frames_before_occlusion(consistent)) < len(consistent):
        return kept
    return len(consistent) // 2 if check_residuals(refined) else len(consistent)


def frames_before_occlusion(consistent: NDArray[np.bool_]) -> int:
    """The number of frames before an occlusion: after them most frames are not ``consistent`` (F,).

    The filter may have followed the occluder there.
    """
    balance = np.cumsum(np.where(consistent, 1, -1))
    return len(consistent) - int(np.argmax(balance[::-1]))


def check_interval(speed: float, half_width: float, random: float = 0.0) -> str:
    """The reason to reject an interval, else empty.

    ``half_width`` is that of the whole interval and ``random`` that without the calibration's part, both m/s.
    """
    for width, share, cause in ((half_width, 1.0, ""), (random, MAX_RANDOM_SHARE, " without the calibration's part")):
        if width > share * max(MAX_HALF_WIDTH[0] * speed, MAX_HALF_WIDTH[1]):
            relative = width / max(speed, 1e-9)
            return "interval too wide: " + (f"± {relative:.1%} of the speed{cause}" if relative < 1 else SPEED_UNKNOWN)
    return ""


def apply_tolerance(m: Measurement, tolerance: float | None) -> Measurement:
    """``m``, rejected if its 95 % interval is wider than ± ``tolerance`` (m/s), which the user states."""
    if tolerance is None or m.verdict != "measured" or (half_width := (m.speed_hi - m.speed_lo) / 2) <= tolerance:
        return m
    return replace(m, verdict="rejected", reason=f"interval too wide: {half_width / tolerance:.2f} times the tolerance")
