"""Tracks of detections: data association over time along the lanes."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field

import cv2
import numpy as np

from paceline.arrays import Array
from paceline.detection.detector import FINE_GRID, Detection
from paceline.detection.lane_paths import LanePath
from paceline.detection.track_motion import MIN_STAND_S, MIN_TRAVEL_M_PX, STAND_REACH_M_PX, TrackMotion
from paceline.robust_line import theil_sen_slope
from paceline.speed.configuration import DEFAULT_LIMITS

MIN_NCC = 0.5  # least NCC of the faces of one vehicle in two frames
# from which on the position is predicted so well that no NCC is needed, because part of the vehicle may be hidden
MIN_PREDICTABLE_DETECTIONS, MAX_PREDICTABLE_GAP_S = 3, 1.0
MAX_LATERAL_STEP_M = 1.3  # from one detection to the next,
MAX_LATERAL_GAP_M = 0.5  # or between what is seen of a vehicle on either side of a pole
POSITION_ERROR_M_PX = 2.5, 1.5  # greatest error of a detection along the lane, m, or px of disparity if that is more
MAX_ACCELERATION_MPS2, BRAKING_MPS2 = 8.0, 3.0  # at most, and before a light
MAX_COMPARED_HEIGHT_M = 1.3  # height up to which faces are compared: windscreens reflect the surroundings
MAX_COMPARISON_SHIFT_M = 0.35  # greatest shift of a face on its plane in the comparison
MAX_UNSEEN_FRAMES, MAX_UNSEEN_S = 3, 0.7  # a track that exceeds both has ended,
MAX_GAP_S = 1.5  # and one that exceeds this in any case: frames may be missing, and the prediction is worth nothing
MIN_SPACING_ALONG_M, MIN_SPACING_ACROSS_M = 6.0, 2.5  # detections that are nearer than both are of one vehicle
ABREAST_SPACING_M = 3.0  # lateral distance above which there are always two vehicles
SPEED_DETECTIONS, PREDICTION_DETECTIONS = 8, 4  # latest ones used for the speed and for the next position
MAX_JOINT_RESIDUAL = 0.8  # median, in position errors, of two tracks of one vehicle about their joint motion
ACCELERATION_STD_MPS2 = 1.0  # standard deviation of the acceleration in that motion
MOTION_IRLS_ITERATIONS = 10  # iterations of the L1 fit of a motion by reweighted least squares
MIN_MOTION_RESIDUAL = 0.05  # least residual in its weights, in position errors
MAX_KEPT_DETECTIONS = 12  # evenly spread detections that are kept of a track


@dataclass(eq=False)
class DetectionTrack:
    """The detections of one vehicle in order of time; ``kept`` are evenly spread ones from the first to about the
    last, without those in which it stands, that all show the same."""

    arc_lengths: list[float] = field(default_factory=list)  # m along the lane of the first detection
    times: list[float] = field(default_factory=list)
    areas: list[float] = field(default_factory=list)
    upright_ratios: list[float] = field(default_factory=list)
    positions: list[Array] = field(default_factory=list)  # world points (3,)
    pixels: list[float] = field(default_factory=list)  # m along the lane that correspond to a pixel of disparity
    kept: list[Detection] = field(default_factory=list)
    last: Detection | None = None
    frames_unseen: int = 0  # since the last detection
    frames_missed: int = 0  # between the first and the last detection
    beside: DetectionTrack | None = None  # the vehicle abreast, from which a gap separates this one
    may_be_two: bool = False  # whether some detections, too few, are as wide as two vehicles with a gap between them
    _driving: int = 0  # detections in which it does not stand
    _stride: int = 1

    def add(self, detection: Detection) -> None:
        self.arc_lengths.append(self.arc_length(detection))
        self.times.append(detection.time)
        self.pixels.append(detection.distance_error(0.0, 1.0))
        if not self._stands:
            if self._driving % self._stride == 0:
                self.kept.append(detection)
                if len(self.kept) > MAX_KEPT_DETECTIONS:
                    self.kept, self._stride = self.kept[::2], 2 * self._stride
            self._driving += 1
        self.areas.append(detection.area)
        self.upright_ratios.append(detection.upright_ratio)
        self.positions.append(detection.position)
        self.frames_missed += self.frames_unseen
        self.last, self.frames_unseen = detection, 0

    @property
    def first(self) -> Detection:
        return self.kept[0]

    @property
    def width(self) -> float:
        """Median width of the detections, m."""
        return float(np.median([s.x[1] - s.x[0] for s in self.kept]))

    def arc_length(self, detection: Detection) -> float:
        """Arc length of a detection on this track's lane, m."""
        if not self.kept or detection.lane is self.first.lane:
            return detection.s
        return self.first.lane.path.nearest(detection.position)

    @property
    def motion(self) -> TrackMotion:
        """Its places along the lane."""
        return TrackMotion(np.array(self.times), np.array(self.arc_lengths), np.array(self.pixels))

    @property
    def is_moving(self) -> bool:
        """Whether it has travelled, before or after it stood."""
        motion = self.motion
        return motion.exceeds(MIN_TRAVEL_M_PX) or bool(motion.drives())

    @property
    def _stands(self) -> bool:
        """Whether it has stayed where it is for the last `MIN_STAND_S`."""
        start = bisect_right(self.times, self.times[-1] - MIN_STAND_S) - 1
        if start < 0:
            return False
        latest = self.arc_lengths[start:]
        return max(latest) - min(latest) <= max(STAND_REACH_M_PX[0], STAND_REACH_M_PX[1] * self.pixels[-1])

    def same_vehicle(self, other: DetectionTrack) -> bool:
        """Whether this track and ``other`` follow one vehicle: one motion then fits the detections of both about the
        time that they share. Those abreast, between which a gap was seen, are two."""
        if other is self.beside:
            return False
        start, end = max(self.times[0], other.times[0]), min(self.times[-1], other.times[-1])
        earlier, later = (self, other) if self.times[0] <= other.times[0] else (other, self)
        if start - end > MAX_GAP_S:
            return earlier.may_have_stood_until(later)
        if start > end and not earlier.may_go_on_as(later):
            return False
        lane, shared = self.first.lane, (min(start, end) - MAX_GAP_S, max(start, end) + MAX_GAP_S)
        own_observations, others = self._observations(lane, *shared), other._observations(lane, *shared)
        lateral_distance = abs(np.median(own_observations[3]) - np.median(others[3]))
        if lateral_distance > max(MIN_SPACING_ACROSS_M, min(0.5 * (self.width + other.width), ABREAST_SPACING_M)):
            return False
        residuals = np.abs(motion_residuals(*np.hstack([own_observations, others])[:3]))
        count = own_observations.shape[1]
        return bool(max(np.median(residuals[:count]), np.median(residuals[count:])) <= MAX_JOINT_RESIDUAL)

    def may_go_on_as(self, later: DetectionTrack) -> bool:
        """Whether the vehicle of this track, which has ended, may have driven to where a ``later`` one begins."""
        if len(self.times) == 1:
            return True
        predicted, gate = self._prediction(later.times[0])
        s = self.first.lane.path.nearest(later.positions[0])
        return bool(abs(s - predicted) <= gate + self._error(-1) + later._error(0))

    def may_have_stood_until(self, later: DetectionTrack) -> bool:
        """Whether the vehicle of this track, which has ended, has come to a stand in the place from which that of a
        ``later`` one drives off: what stands becomes part of the background, and none passes it in its lane."""
        s, offset, _ = self.first.lane.plane_coordinates(later.positions[0])
        last_offset = self.first.lane.plane_coordinates(self.positions[-1])[1]
        is_there = abs(s - self.arc_lengths[-1]) <= self._error(-1) + later._error(0)
        is_beside = abs(offset - last_offset) > MAX_LATERAL_STEP_M
        stops = self._is_about_to_stand(slice(-PREDICTION_DETECTIONS, None), -1)
        return is_there and not is_beside and stops and later._is_about_to_stand(slice(PREDICTION_DETECTIONS), 0)

    def _is_about_to_stand(self, detections: slice, k: int) -> bool:
        """Whether by the speed in some ``detections`` the vehicle stands within the error of its place at ``k``: it
        brakes to a stand there, or has just driven off."""
        speed = theil_sen_slope(np.array(self.times[detections]), np.array(self.arc_lengths[detections]))
        return bool(speed**2 / (2.0 * BRAKING_MPS2) <= self._error(k))

    def _error(self, k: int) -> float:
        """Greatest error of a detection along the lane, m."""
        return max(POSITION_ERROR_M_PX[0], POSITION_ERROR_M_PX[1] * self.pixels[k])

    def _observations(self, lane: LanePath, start: float, end: float) -> Array:
        """Times, arc lengths on ``lane``, errors and lateral offsets (4, N) of the detections from ``start`` to
        ``end``."""
        observations = []
        for k, (time, position) in enumerate(zip(self.times, self.positions, strict=True)):
            if start <= time <= end:
                s, offset, _ = lane.plane_coordinates(position)
                observations.append((time, s, self._error(k), offset))
        return np.array(observations).T

    def is_predictable(self, time: float) -> bool:
        """Whether the position at ``time`` is predicted well enough to associate a detection without a comparison of
        images."""
        return len(self.times) >= MIN_PREDICTABLE_DETECTIONS and time - self.times[-1] <= MAX_PREDICTABLE_GAP_S

    def in_gate(self, detection: Detection) -> bool:
        """Whether the vehicle may have driven to the place of ``detection``."""
        assert self.last is not None, "a track begins with a detection"
        dt = detection.time - self.times[-1]
        if dt > MAX_GAP_S:
            return False
        s, lane = self.arc_length(detection), self.first.lane
        lateral = (detection.position - self.last.position) @ lane.axes(s)[1]
        half_widths = 0.5 * (detection.x[1] - detection.x[0] + self.last.x[1] - self.last.x[0])
        if abs(lateral) > max(MAX_LATERAL_STEP_M, half_widths + MAX_LATERAL_GAP_M):
            return False
        error = detection.distance_error(*POSITION_ERROR_M_PX)
        if len(self.times) == 1:
            return bool(abs(s - self.arc_lengths[-1]) <= DEFAULT_LIMITS.max_speed * dt + error)
        predicted, gate = self._prediction(detection.time)
        return bool(abs(s - predicted) <= gate + error)

    def _prediction(self, time: float) -> tuple[float, float]:
        """Where the vehicle is at a later ``time`` by its latest detections, of which there are two at least, and how
        far it may be from there, both m along the lane."""
        recent = slice(-SPEED_DETECTIONS, None)
        t, places = np.array(self.times[recent]) - time, np.array(self.arc_lengths[recent])
        v = theil_sen_slope(t, places)
        gate = self._error(-1) * -t[-1] / (t[-1] - t[0]) + 0.5 * MAX_ACCELERATION_MPS2 * t[-1] ** 2
        return float(np.median((places - v * t)[-PREDICTION_DETECTIONS:])), float(gate)


def motion_residuals(t: Array, s: Array, error: Array) -> Array:
    """The residuals (N,), in units of ``error``, of positions ``s`` at times ``t`` about the motion of constant
    acceleration with the least sum of absolute residuals, the acceleration's own included."""
    powers, places = np.vander(t - t.mean(), 3) / error[:, None], s / error
    prior = np.array([[2.0 / ACCELERATION_STD_MPS2, 0.0, 0.0]])
    weight = np.ones(len(t) + 1)
    for _ in range(MOTION_IRLS_ITERATIONS):
        A, b = weight[:, None] * np.concatenate([powers, prior]), weight * np.append(places, 0.0)
        motion = np.linalg.lstsq(A, b, rcond=None)[0]
        residuals = np.append(places - powers @ motion, prior @ motion)
        weight = 1.0 / np.sqrt(np.maximum(np.abs(residuals), MIN_MOTION_RESIDUAL))
    return np.asarray(residuals[:-1])


def similarity(a: Detection, b: Detection) -> float:
    """The best NCC of the lower part of the narrower face with the plane of the other one, shifted a little, and
    anywhere within a wider one, which may contain more than the vehicle."""
    if b.x[1] - b.x[0] < a.x[1] - a.x[0]:
        a, b = b, a
    template, searched = (s.warp(s.s, FINE_GRID, np.array([s.lateral_offset, 0.0]))[0] for s in (a, b))
    width, wider = a.x[1] - a.x[0], b.x[1] - b.x[0]
    columns = np.flatnonzero(np.abs(FINE_GRID.x) <= 0.5 * width)
    rows = np.flatnonzero(FINE_GRID.y <= max(MAX_COMPARED_HEIGHT_M, a.y[0] + 0.4))
    down, across = (
        round(reach / FINE_GRID.cell)
        for reach in (MAX_COMPARISON_SHIFT_M, MAX_COMPARISON_SHIFT_M + 0.5 * (wider - width))
    )
    pad = cv2.copyMakeBorder(searched, down, down, across, across, cv2.BORDER_REPLICATE)
    window = pad[rows[0] : rows[-1] + 1 + 2 * down, columns[0] : columns[-1] + 1 + 2 * across].copy()
    face = template[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].copy()
    scores = cv2.matchTemplate(window, face, cv2.TM_CCOEFF_NORMED)
    return float(np.nan_to_num(scores, nan=-1.0, posinf=-1.0).max())


def same_vehicle_in_frame(a: Detection, b: Detection) -> bool:
    """Whether two detections in one frame are so near each other that they are parts of one vehicle."""
    displacement = a.position - b.position
    forward, right, _ = b.lane.path.frames(np.array(b.s)).T
    return bool(abs(displacement @ forward) < MIN_SPACING_ALONG_M and abs(displacement @ right) < MIN_SPACING_ACROSS_M)


class TrackAssociator:
    """Associates the detections of frame after frame with tracks, and returns each track when it has ended."""

    def __init__(self) -> None:
        self.tracks: list[DetectionTrack] = []

    def associate(self, time: float, detections: list[Detection]) -> list[DetectionTrack]:
        """Add ``detections`` at ``time`` to the tracks, or begin new ones; returns the tracks that have ended by
        now."""
        pairs: list[tuple[bool, float, int, int]] = []
        for i, track in enumerate(self.tracks):
            if track.last is None or not (near := [j for j, d in enumerate(detections) if track.in_gate(d)]):
                continue
            # moving tracks first: a stationary object, such as a bush, is hidden by a vehicle and seen again later
            is_moving = track.is_moving
            pairs += [(is_moving, similarity(track.last, detections[j]), i, j) for j in near]
        taken_tracks: set[int] = set()
        used_detections: set[int] = set()
        for _, score, i, j in sorted(pairs, reverse=True):
            accepted = score >= MIN_NCC or self.tracks[i].is_predictable(time)
            if accepted and i not in taken_tracks and j not in used_detections:
                self.tracks[i].add(detections[j])
                taken_tracks.add(i)
                used_detections.add(j)
        ended = []
        for i, track in enumerate(self.tracks):
            if i not in taken_tracks:
                track.frames_unseen += 1
                unseen = time - track.times[-1]
                if unseen > MAX_GAP_S or (track.frames_unseen > MAX_UNSEEN_FRAMES and unseen > MAX_UNSEEN_S):
                    ended.append(track)
        self.tracks = [track for track in self.tracks if track not in ended]
        associated = [detections[j] for j in used_detections]
        for j, detection in enumerate(detections):
            if j not in used_detections and not any(same_vehicle_in_frame(detection, other) for other in associated):
                self.tracks.append(DetectionTrack())
                self.tracks[-1].add(detection)
        return ended
