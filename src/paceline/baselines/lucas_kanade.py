"""Lucas–Kanade stereo: a carefully engineered OpenCV tracker.

Corners in the vehicle's region are tracked over time and matched across the views, both with a forward-backward check
and sub-pixel precision, and triangulated; the motion between frames is their robust common displacement. At the end the
points of all frames are aligned together, and a straight line or a curve in time is fitted to the positions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from paceline.arrays import Array, Image, Indices, Mask
from paceline.baselines import optical_flow, polynomial_track
from paceline.baselines.rigid_alignment import align
from paceline.baselines.template_tracking import ScaledShift, TemplateTracker, shift_between
from paceline.baselines.track import FrameResult, MeanSpeed, check_frame_count, measurement_of, rejected, unseen_frame
from paceline.baselines.triangulation_covariance import triangulation_covariance
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.geometry import epipolar_distance, triangulate
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import Limits
from paceline.speed.geometry.paths import level_frames
from paceline.speed.measurement import by_vehicle
from paceline.speed.methods import register
from paceline.speed.results import Measurement
from paceline.verdicts import message

MIN_POINTS = 4
MAX_CORNER_EPIPOLAR_PX = 1.0
MAX_MOTION_RESIDUAL_PX = 1.5  # greatest distance of a point from the common motion of the region
MAX_CORNER_DEPTH_DEVIATIONS = 4.0  # scaled median deviations of inverse depth beyond which a match is an outlier
CORNER_MATCH_SIGMA_PX = 0.15  # standard deviation of a matched coordinate
DISPLACEMENT_HUBER_SIGMA = 1.5
KEYFRAME_SCALE_RATIO = 1.2  # change of scale that starts a new keyframe
KEYFRAME_POINT_SHARE = 0.6  # share of the keyframe's points still tracked, below which a new keyframe starts
JACKKNIFE_GROUPS = 8  # groups of points, each left out once
ALIGNMENT_PASSES = 2  # passes of the alignment and of the rotation along the track
MAX_ALIGNED_FRAMES = 32  # longer tracks are subsampled evenly


class LucasKanade:
    """The Lucas–Kanade tracker of one vehicle."""

    def __init__(self, rig: StereoRig, vehicle: VehicleDocument, limits: Limits) -> None:
        self.rig, self.vehicle, self.limits = rig, vehicle, limits
        self.frame_results: list[FrameResult] = []
        self._templates: TemplateTracker | None = None
        self._keyframe: _Keyframe
        self._tracked: list[tuple[int, _Matches]] = []  # by row of the frame results
        self._next = 0  # number of the next new point

    def process(self, frame: StereoFrame) -> bool:
        """Process ``frame``; whether the vehicle can be tracked further."""
        if self._templates is None:
            return self._initialize(frame)
        regions, before = self._templates, self._tracked[-1][1]
        moves = regions.find(frame)
        tracked_quads = None if moves is None else self._track(frame, moves)
        if tracked_quads is None:
            further = regions.record_missed(frame.time)
            self.frame_results.append(unseen_frame(frame, regions))
            return further
        matches, quads = tracked_quads
        dt = frame.time - regions.time
        regions.record_found(quads, frame)
        displacement, spread = _displacement(self.rig, before, matches)
        speed = float(np.linalg.norm(displacement)) / dt
        ahead = displacement / np.maximum(speed * dt, 1e-12)
        self._record(frame, matches, speed, float(np.sqrt(ahead @ spread @ ahead)) / dt)
        return regions.status == "tracking"

    def _initialize(self, frame: StereoFrame) -> bool:
        quads = np.stack([self.vehicle.left, self.vehicle.right])
        no_matches = _Matches(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 3)))
        try:
            self._templates = TemplateTracker(self.rig, quads, frame)
        except np.linalg.LinAlgError:
            return False
        matches = self._add_points(frame, no_matches, quads)
        self._keyframe = _Keyframe((frame.left, frame.right), quads, matches)
        self._record(frame, matches, self.vehicle.speed or float("nan"), float("nan"))
        return len(matches.number) >= MIN_POINTS

    def _track(self, frame: StereoFrame, moves: tuple[ScaledShift, ScaledShift]) -> tuple[_Matches, Array] | None:
        """The points tracked into ``frame`` and the regions (2, 4, 2) moved with them; None where too few are found.

        Points are tracked from the last keyframe, not from the last frame, so that errors accumulate less often.
        """
        assert self._templates is not None
        key, expected = self._keyframe, [m(q) for m, q in zip(moves, self._templates.quads, strict=True)]
        left_move, right_move = (shift_between(a, b) for a, b in zip(key.quads, expected, strict=True))
        window = optical_flow.window_size(expected[0])
        left, valid = optical_flow.track_points(key.images[0], frame.left, key.matches.left, left_move, window)
        valid &= self._follows_common_motion(key.matches.left, left, valid)
        if valid.sum() < MIN_POINTS:
            return None
        from_key = key.matches.select(valid)
        left = left[valid]
        right, valid = optical_flow.match_points(frame.left, frame.right, left, right_move(from_key.right), window)
        valid &= self._is_consistent(left, right, valid)
        if valid.sum() < MIN_POINTS:
            return None
        from_key, left, right = from_key.select(valid), left[valid], right[valid]
        matches = _Matches(from_key.number, left, right, triangulate(self.rig, left, right))
        transforms = _similarity(from_key.left, left), _similarity(from_key.right, right)
        quads = [q @ m[:, :2].T + m[:, 2] for q, m in zip(key.quads, transforms, strict=True) if m is not None]
        if len(quads) < 2:
            return None
        grown = abs(np.log(shift_between(key.quads[0], quads[0]).scale))
        if grown > np.log(KEYFRAME_SCALE_RATIO) or len(left) < KEYFRAME_POINT_SHARE * len(key.matches.number):
            matches = self._add_points(frame, matches, np.stack(quads))
            self._keyframe = _Keyframe((frame.left, frame.right), np.stack(quads), matches)
        return matches, np.stack(quads)

    def _add_points(self, frame: StereoFrame, matches: _Matches, quads: Array) -> _Matches:
        """``matches`` together with those of new corners in the regions ``quads`` (2, 4, 2)."""
        new = optical_flow.detect_corners(frame.left, quads[0], matches.left)
        if not len(new):
            return matches
        across = cv2.getPerspectiveTransform(quads[0].astype(np.float32), quads[1].astype(np.float32))
        guess = np.asarray(cv2.perspectiveTransform(new[:, None], across), float)[:, 0]
        right, valid = optical_flow.match_points(
            frame.left, frame.right, new, guess, optical_flow.window_size(quads[0])
        )
        valid &= self._is_consistent(new, right, valid)
        number = self._next + np.arange(int(valid.sum()))
        self._next += len(number)
        return _Matches(
            np.concatenate([matches.number, number]),
            np.concatenate([matches.left, new[valid]]),
            np.concatenate([matches.right, right[valid]]),
            np.concatenate([matches.points, triangulate(self.rig, new[valid], right[valid])]),
        )

    def _follows_common_motion(self, before: Array, after: Array, valid: Mask) -> Mask:
        """Which points follow the dominant motion in the image."""
        consistent = np.zeros(len(before), bool)
        if valid.sum() >= MIN_POINTS and (move := _similarity(before[valid], after[valid])) is not None:
            residual = np.linalg.norm(before @ move[:, :2].T + move[:, 2] - after, axis=1)
            consistent = residual < MAX_MOTION_RESIDUAL_PX * (1 + 0.01 * np.ptp(after[valid]))
        return consistent

    def _is_consistent(self, left: Array, right: Array, valid: Mask) -> Mask:
        """Which matches lie on their epipolar lines and at a consistent depth."""
        plausible = valid & (np.abs(epipolar_distance(self.rig, left, right)) < MAX_CORNER_EPIPOLAR_PX)
        depth = triangulate(self.rig, left, right)[:, 2]
        plausible &= np.isfinite(depth) & (depth > 1.0)
        if plausible.any():
            inverse = 1.0 / np.where(plausible, depth, 1.0)
            deviation = np.abs(inverse - np.median(inverse[plausible]))
            min_deviation = CORNER_MATCH_SIGMA_PX / (self.rig.left.K[0, 0] * self.rig.baseline)
            plausible &= deviation < MAX_CORNER_DEPTH_DEVIATIONS * max(
                1.4826 * float(np.median(deviation[plausible])), min_deviation
            )
        return plausible

    def _record(self, frame: StereoFrame, matches: _Matches, speed: float, std: float) -> None:
        assert self._templates is not None
        quads = self._templates.quads
        result = FrameResult(
            frame=frame.index,
            time=frame.time,
            left=quads[0],
            right=quads[1],
            status=self._templates.status,
            speed=speed,
            speed_std=std,
            position=triangulate(self.rig, quads[0].mean(0), quads[1].mean(0)),
            points_left=matches.left,
            points_right=matches.right,
            effective_points=float(len(matches.number)),
        )
        if result.status == "tracking":
            self._tracked.append((len(self.frame_results), matches))
        self.frame_results.append(result)

    def result(self) -> Measurement:
        """The measurement, from the alignment of all matches."""
        name = self.vehicle.id
        if not self._tracked or len(self._tracked[0][1].number) < MIN_POINTS:
            test = f"fewer than {MIN_POINTS} corners match across the views"
            return rejected(name, self.frame_results, message("too_little_texture", test=test))
        if too_few := check_frame_count(self.frame_results, self.limits):
            return rejected(name, self.frame_results, too_few)
        try:
            track, places, groups = self._fit()
        except np.linalg.LinAlgError:
            test = "the equations of its motion are singular"
            return rejected(name, self.frame_results, message("no_motion_fits", test=test))
        times = np.array([s.time for s in self.frame_results])
        rows = list(places)
        speeds, stds = (np.full(len(times), np.nan) for _ in range(2))
        speeds[rows], stds[rows] = track.speeds(times[rows])
        for row, place in places.items():
            self.frame_results[row] = replace(self.frame_results[row], position=place)
        speed, scatter = track.mean_speed()
        # frames scatter about the track, and the matches of one point err alike in all of them
        std = float(np.hypot(scatter, np.sqrt((JACKKNIFE_GROUPS - 1) * np.var(groups))))
        stds *= std / max(scatter, 1e-12)
        mean = MeanSpeed(speed, std, JACKKNIFE_GROUPS - 1, track.model, speeds, stds)
        return measurement_of(name, self.frame_results, mean, self.limits)

    def _fit(self) -> tuple[polynomial_track.PolynomialTrack, dict[int, Array], list[float]]:
        """The track fitted to the aligned positions, these by row of the frame results, and the mean speeds with one
        group of points left out at a time (jackknife)."""
        chosen = np.unique(
            np.linspace(0, len(self._tracked) - 1, min(len(self._tracked), MAX_ALIGNED_FRAMES)).round().astype(int)
        )
        rows = [self._tracked[i][0] for i in chosen]
        matches = [self._tracked[i][1] for i in chosen]
        number = np.unique(np.concatenate([m.number for m in matches]))
        observed = np.zeros((len(number), len(rows)), bool)
        points = np.zeros((*observed.shape, 3))
        for k, m in enumerate(matches):
            frame_index = np.searchsorted(number, m.number)
            observed[frame_index, k], points[frame_index, k] = True, m.points
        times = np.array([self.frame_results[row].time for row in rows])
        positions = np.array([self.frame_results[row].position for row in rows])
        rotations = np.tile(np.eye(3), (len(rows), 1, 1))
        for _ in range(ALIGNMENT_PASSES):
            aligned = align(points, observed, rotations, positions)
            track = polynomial_track.fit_polynomial(times, aligned.positions, aligned.covariance)
            if track.degree == 1:
                break
            frames = level_frames(track.velocities(times))
            rotations = frames @ frames[0].T
        groups = []
        for group in range(JACKKNIFE_GROUPS):
            included = np.arange(len(observed)) % JACKKNIFE_GROUPS != group
            jackknife = align(points[included], observed[included], rotations, aligned.positions)
            groups.append(
                polynomial_track.fit_polynomial(
                    times, jackknife.positions, jackknife.covariance, track.degree
                ).mean_speed()[0]
            )
        return track, dict(zip(rows, aligned.positions, strict=True)), groups


@dataclass(frozen=True, eq=False)
class _Matches:
    """Points of one frame: their ``number`` (n,), pixels ``left`` and ``right`` (n, 2), and ``points`` (n, 3) m."""

    number: Indices
    left: Array
    right: Array
    points: Array

    def select(self, selection: Mask) -> _Matches:
        return _Matches(self.number[selection], self.left[selection], self.right[selection], self.points[selection])


@dataclass(frozen=True, eq=False)
class _Keyframe:
    """A keyframe, from which points are tracked: its images, regions (2, 4, 2) and points."""

    images: tuple[Image, Image]
    quads: Array
    matches: _Matches


def _displacement(rig: StereoRig, before: _Matches, after: _Matches) -> tuple[Array, Array]:
    """The robust common displacement (3,) of the points seen in both frames, and its covariance (3, 3); NaN where no
    point is."""
    _, i, j = np.intersect1d(before.number, after.number, return_indices=True)
    if not len(i):
        return np.full(3, np.nan), np.full((3, 3), np.nan)
    a, b = before.points[i], after.points[j]
    W = np.linalg.inv(
        triangulation_covariance(rig, a, CORNER_MATCH_SIGMA_PX)
        + triangulation_covariance(rig, b, CORNER_MATCH_SIGMA_PX)
    )
    d, w = b - a, np.ones(len(a))
    for _ in range(6):
        A = np.einsum("n,nij->ij", w, W)
        mean = np.linalg.solve(A, np.einsum("n,nij,nj->i", w, W, d))
        distance = np.sqrt(np.einsum("ni,nij,nj->n", d - mean, W, d - mean))
        scale = max(float(np.median(distance)) / 1.54, 1e-6)
        w = np.minimum(1.0, 2 * DISPLACEMENT_HUBER_SIGMA * scale / np.maximum(distance, 1e-12))
    return mean, np.linalg.inv(A) * scale**2


def _similarity(before: Array, after: Array) -> Array | None:
    """The dominant similarity transform (2, 3), by RANSAC."""
    cv2.setRNGSeed(0)
    move = cv2.estimateAffinePartial2D(before, after, method=cv2.RANSAC, ransacReprojThreshold=MAX_MOTION_RESIDUAL_PX)[
        0
    ]
    return None if move is None else np.asarray(move, float)


register("lucas-kanade", by_vehicle(lambda clip, vehicle, path, c: LucasKanade(clip.rig, vehicle, c.limits)))
