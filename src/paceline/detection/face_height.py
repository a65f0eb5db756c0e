"""Selection of a face's upper edge: the top, which may be behind the plane of the face, is cut where it adds little
information on the motion.

A bonnet or a windscreen above a face matches in both views and over time nearly as well as the face does. At a distance
no parallax distinguishes it from the face, but the fit of the motion explains it as a tilt of the face, which absorbs
the information that it could give. So the motion is fitted to outlines of several heights, and the lowest is selected
whose speed has nearly the smallest standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from paceline.arrays import Array
from paceline.detection.planar_face import AlignedDetection, PlanarFace, face_positions
from paceline.documents.loading import VehicleDocument
from paceline.robust_line import theil_sen_slope
from paceline.speed.configuration import DEFAULT_LIMITS, DEFAULTS, DriverSettings
from paceline.speed.geometry.initial_plane import plane_from_outlines
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.path_deviation import deviation_of
from paceline.speed.refinement.photometric_fit import PhotometricFit
from paceline.speed.refinement.trajectory import Trajectory, exact_timing, prior

HEIGHT_STEP_M = 0.075  # difference in height of two successive outlines
MIN_OUTLINE_HEIGHT_M = 0.35  # least height of an outline
MAX_SPEED_STD_RATIO = 0.03  # relative standard deviation of a speed up to which the comparison is meaningful
MAX_STD_RATIO = 1.15  # of the selected outline's standard deviation of speed to the smallest one
MAX_STD_RATIO_STOP = 1.4  # of the same, above which no lower outline is tried
OUTLINE_STD_PX = 0.5  # standard deviation of an outline's corner, as of one drawn by hand
REFIT_STEPS = 2  # steps of a fit that starts from that of the previous outline


def select_height(
    face: PlanarFace,
    detections: list[AlignedDetection],
    is_clear: Callable[[PlanarFace], bool],
    driver: DriverSettings = DEFAULTS.driver,
) -> PlanarFace:
    """``face`` cut at its top: the lowest outline that ``is_clear`` and whose speed over the ``detections``, in order
    of time, has nearly the smallest standard deviation."""
    low, high = face.y
    tops = np.arange(high - HEIGHT_STEP_M, low + MIN_OUTLINE_HEIGHT_M, -HEIGHT_STEP_M).tolist()
    lower = [replace(face, y=(low, top)) for top in tops]
    outlines = [face, *filter(is_clear, lower)]
    if len(outlines) == 1 or len(detections) < DEFAULT_LIMITS.min_frames:
        return face
    stds = _speed_stds(outlines, detections, driver)
    return outlines[int(np.flatnonzero(stds <= MAX_STD_RATIO * stds.min())[-1])]


def _speed_stds(outlines: list[PlanarFace], detections: list[AlignedDetection], driver: DriverSettings) -> Array:
    """The standard deviations of the mean speed, m/s, due to pixel noise, with each of the ``outlines`` in the frames
    ``detections``; only those of the first ones where the others are far worse."""
    keyframes = [_keyframe(outlines[0], aligned) for aligned in detections]
    stds: list[float] = []
    try:
        trajectory, speed = _initial_trajectory(keyframes, detections, driver)
        fit = PhotometricFit(trajectory, keyframes, prior(trajectory, speed))
        stds.append(fit.noise_std)
        for face in outlines[1:]:
            if stds[-1] > MAX_STD_RATIO_STOP * min(stds) or stds[0] > MAX_SPEED_STD_RATIO * speed:
                break
            fit = fit.on_outline(_outline_pixels(face, detections[0])[0], REFIT_STEPS)
            stds.append(fit.noise_std)
    except np.linalg.LinAlgError:
        pass  # an outline that does not determine the motion: the whole one is kept, or the best of those fitted so far
    return np.array(stds or [0.0])


def _outline_pixels(face: PlanarFace, aligned: AlignedDetection) -> Array:
    """An outline (2, 4, 2) in both views of a frame, px."""
    return np.stack(aligned.detection.lane.pixels(aligned.s, face.corners(aligned)))


def _keyframe(face: PlanarFace, aligned: AlignedDetection) -> Keyframe:
    d = aligned.detection
    return Keyframe(d.frame, (d.time, d.time), d.crops, d.crop_origins, _outline_pixels(face, aligned))


def _initial_trajectory(
    keyframes: list[Keyframe], detections: list[AlignedDetection], driver: DriverSettings
) -> tuple[Trajectory, float]:
    """The outline of the first keyframe moved along its lane, and its speed, m/s."""
    lane, (left, right) = detections[0].detection.lane, keyframes[0].quads
    times = np.array([k.times for k in keyframes]) - keyframes[0].times[0]
    speed = theil_sen_slope(*face_positions(detections))
    path = lane.path if speed > 0 else lane.path.reversed()
    document = VehicleDocument("", lane.name, keyframes[0].frame, left, right, "front", None)
    plane = plane_from_outlines(lane.rig, document, path, OUTLINE_STD_PX)
    deviation = deviation_of(path, plane, times, abs(speed), on_path=True, driver=driver)
    exact, none = exact_timing(len(times)), np.zeros(2)
    return Trajectory(lane.rig, left, plane, path, times, deviation, times.mean(1), exact, none, driver), abs(speed)
