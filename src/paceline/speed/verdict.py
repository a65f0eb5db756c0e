"""Whether a refined motion is a measurement: what the pictures of every frame say, and how sure the speed is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from paceline.speed.refinement.model_selection import Refined
from paceline.speed.results import Measurement
from paceline.units import SpeedUnit

LEAST_FRAMES = 4
MISFIT = 0.6  # share of the texture's contrast that may stay unexplained
OFF = 0.6  # px, rms over the frames: how far the pictures may lie off the motion
SHOWN = 0.5  # share of the frames that have to show the vehicle where the fitted motion puts it
DISAGREE = 1.0  # px across the epipolar lines
FASTEST = 90.0  # m/s
STRAYED = 3.0  # standard deviations, rms over the modes of a way, that it may bend by a face with a contrast below
FAINT = 5.0  # grey levels: such a one is easily followed to where it is not
OUTLINED = 5.0  # standard deviations of an outline's place, by its corners, that the motion may lie off it
CONTRADICTED = 5.0  # standard deviations of what pictures put right of a calibration, beyond which it is another one
WIDEST = (0.06, SpeedUnit.KMH.mps)  # half-width of an interval that still counts: relative, and m/s
UNKNOWN = "the speed is not known"
OWN = 2 / 3  # share of that which may be the vehicle's own, not the calibration's


def against(refined: Refined, speed: float, half: float) -> str:
    """Why a ``speed`` (m/s), known to ± ``half``, is no measurement; empty where it is one, if it is known well
    enough."""
    if not np.isfinite([speed, half]).all():
        return "residuals: no motion explains the pictures"
    if reason := unexplained(refined):
        return reason
    across = float(np.nanmedian(refined.offsets[:, 1, 1] - refined.offsets[:, 0, 1]))
    if abs(across) > DISAGREE:
        return f"views disagree: they lie {abs(across):.1f} px apart across the epipolar lines"
    if (pull := float(np.abs(refined.rig_pulls).max(initial=0.0))) > CONTRADICTED:
        return (
            f"calibration: these pictures want the cameras elsewhere, by {pull:.1f} times as much as the uncertainty "
            "in rig.yaml makes usual"
        )
    if not 0 <= speed <= FASTEST:
        return f"implausible: {speed:.1f} m/s"
    if refined.strayed > STRAYED and refined.contrast < FAINT:
        return (
            f"implausible: its way bends {refined.strayed:.0f} times as much as is likely, "
            f"by a face of {refined.contrast:.1f} grey levels"
        )
    return ""


def off_outline(refined: Refined, right: NDArray[np.float64], click_sigma: float) -> str:
    """Why a motion is not that of the vehicle that is outlined by the corners ``right`` (4, 2), px, too, each known to
    ``click_sigma`` px, or as well as they fit each other; empty where it is. The motion has the left outline for its
    own: both views of something that hides the vehicle agree as well, but not on the distance of both outlines."""
    apart = refined.trajectory.quads(refined.theta)[0, 1] - right
    off = apart.mean(0)
    scatter = float(np.sqrt(((apart - off) ** 2).sum() / (apart.size - off.size)))
    lies = float(np.linalg.norm(off))
    most = OUTLINED * max(float(np.sqrt(2.0)) * click_sigma, scatter) / float(np.sqrt(len(apart)))
    if lies <= most:
        return ""
    return f"outline: what the pictures show lies {lies:.1f} px off it in the right view, more than {most:.1f}"


def frames_shown(refined: Refined) -> NDArray[np.bool_]:
    """Which frames (F,) show the vehicle where the fitted motion puts it, in all views that were used of them."""
    used = np.isfinite(refined.explained)
    fits = (refined.explained >= 1.0 - MISFIT**2) & (np.linalg.norm(refined.offsets, axis=-1) <= OFF)
    return np.asarray(used.any(1) & (fits | ~used).all(1))


def unexplained(refined: Refined) -> str:
    """Why the pictures are none of the fitted motion; empty where they are."""
    off = float(np.sqrt(np.nanmean(refined.offsets**2)))
    if not refined.converged:
        return "residuals: no motion explains the pictures"
    if refined.residual > MISFIT * refined.contrast or off > OFF:
        left_over = refined.residual / max(refined.contrast, 1e-9)
        return (
            f"residuals: the pictures lie {off:.1f} px off the fitted motion and "
            f"{left_over:.0%} of their contrast is unexplained"
        )
    shown = frames_shown(refined)
    if shown.mean() < SHOWN or shown.sum() < LEAST_FRAMES:
        return f"residuals: only {shown.sum()} of {len(shown)} frames show the vehicle where the fitted motion puts it"
    if not shown[:LEAST_FRAMES].any():  # it is that of what came to hide the vehicle, and drives on in its place
        return f"residuals: none of the first {LEAST_FRAMES} frames shows the vehicle where the fitted motion puts it"
    return ""


def part_in_view(refined: Refined) -> int:
    """How many of the first frames to fit next, where something hides the vehicle in the others; all where nothing
    does. Where no motion explains the pictures, something may have hidden it early on: then half of them."""
    shown = frames_shown(refined)
    if LEAST_FRAMES <= (kept := in_view(shown)) < len(shown):
        return kept
    return len(shown) // 2 if unexplained(refined) else len(shown)


def in_view(shown: NDArray[np.bool_]) -> int:
    """How many of the first frames to keep: beyond them, fewer of the frames than not have ``shown`` (F,) the vehicle.
    Something hides it there, which the filter may well have followed instead."""
    balance = np.cumsum(np.where(shown, 1, -1))
    return len(shown) - int(np.argmax(balance[::-1]))


def too_wide(speed: float, half: float, own: float = 0.0) -> str:
    """Why an interval of ± ``half`` (m/s), but for the calibration's part of ± ``own``, is none to go by; empty where
    it is."""
    for width, share, cause in ((half, 1.0, ""), (own, OWN, " without the calibration's part")):
        if width > share * max(WIDEST[0] * speed, WIDEST[1]):
            of_it = width / max(speed, 1e-9)
            return "interval too wide: " + (f"± {of_it:.1%} of the speed{cause}" if of_it < 1 else UNKNOWN)
    return ""


def within(m: Measurement, tolerance: float | None) -> Measurement:
    """``m``, rejected if it is measured but its 95 % interval is wider than ± ``tolerance``, m/s, that a user asks
    for."""
    if tolerance is None or m.verdict != "measured" or (half := (m.speed_hi - m.speed_lo) / 2) <= tolerance:
        return m
    return replace(m, verdict="rejected", reason=f"interval too wide: {half / tolerance:.2f} times the tolerance")
