"""Feature triangulation, a comparison method of [Zhu] section V.

SIFT matches between the left and the right image are triangulated with the least reprojection error. The displacement
of their mean between two frames gives the speed at that frame, a polynomial track through all means the mean speed. The
region in which features are sought follows the vehicle by template tracking.
"""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.baselines import polynomial_track
from paceline.baselines.template_tracking import TemplateTracker
from paceline.baselines.track import FrameResult, MeanSpeed, check_frame_count, measurement_of, rejected, unseen_frame
from paceline.baselines.triangulation_covariance import triangulation_covariance
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.geometry import epipolar_distance, triangulate
from paceline.recordings.stereo import StereoFrame
from paceline.sift_features import Descriptors, detect_features, match_descriptors
from paceline.speed.configuration import Limits
from paceline.speed.measurement import by_vehicle
from paceline.speed.methods import register
from paceline.speed.results import Measurement
from paceline.verdicts import Message, message

BASELINE_LOWE_RATIO = 0.8  # ratio of the distances to the best and the second best descriptor (Lowe 2004)
MAX_FEATURE_EPIPOLAR_PX = 1.5
MAX_FEATURE_DEPTH_DEVIATIONS = 3.0  # scaled median deviations of inverse depth beyond which a match is an outlier
MIN_FEATURE_MATCHES = 3
FEATURE_MATCH_SIGMA_PX = 0.5  # standard deviation of a matched feature's coordinate ([Zhu] section V)
DESCRIPTOR_MARGIN_PX = 16  # margin of image around the region, for the descriptors
CONTRAST_THRESHOLD = 0.02  # half of OpenCV's default, as distant vehicles are small


class Sift:
    """The feature tracker of one vehicle."""

    def __init__(self, rig: StereoRig, vehicle: VehicleDocument, limits: Limits) -> None:
        self.rig, self.vehicle, self.limits = rig, vehicle, limits
        self.frame_results: list[FrameResult] = []
        self._templates: TemplateTracker | None = None
        self._detector = cv2.SIFT.create(contrastThreshold=CONTRAST_THRESHOLD)

    def process(self, frame: StereoFrame) -> bool:
        """Process ``frame``; whether the vehicle can be tracked further."""
        if self._templates is None:
            quads = np.stack([self.vehicle.left, self.vehicle.right])
            try:
                self._templates = TemplateTracker(self.rig, quads, frame)
            except np.linalg.LinAlgError:
                return False
        else:
            moves = self._templates.find(frame)
            if moves is None:
                return self._record_missed(frame)
            quads = np.stack([m(q) for m, q in zip(moves, self._templates.quads, strict=True)])
        left, right = self._matches(frame, quads)
        if len(left) < MIN_FEATURE_MATCHES:
            return self._record_missed(frame)
        if self.frame_results:
            self._templates.record_found(quads, frame)
        self._record(frame, left, right)
        return self._templates.status == "tracking"

    def _matches(self, frame: StereoFrame, quads: Array) -> tuple[Array, Array]:
        """Matched features (n, 2) of each view, inside the regions ``quads`` (2, 4, 2)."""
        (a, of_a), (b, of_b) = (
            features_inside(self._detector, image, quad)
            for image, quad in zip((frame.left, frame.right), quads, strict=True)
        )
        i, j = match_descriptors(of_a, of_b, BASELINE_LOWE_RATIO)
        left, right = a[i], b[j]
        with np.errstate(invalid="ignore"):
            inverse = 1.0 / triangulate(self.rig, left, right)[:, 2]
        valid = (np.abs(epipolar_distance(self.rig, left, right)) < MAX_FEATURE_EPIPOLAR_PX) & (inverse > 0)
        if valid.any():
            deviation = np.abs(inverse - np.median(inverse[valid]))
            min_deviation = FEATURE_MATCH_SIGMA_PX / (self.rig.left.K[0, 0] * self.rig.baseline)
            valid &= deviation < MAX_FEATURE_DEPTH_DEVIATIONS * max(
                1.4826 * float(np.median(deviation[valid])), min_deviation
            )
        return left[valid], right[valid]

    def _record_missed(self, frame: StereoFrame) -> bool:
        assert self._templates is not None
        if not self.frame_results:
            return False
        further = self._templates.record_missed(frame.time)
        self.frame_results.append(unseen_frame(frame, self._templates))
        return further

    def _record(self, frame: StereoFrame, left: Array, right: Array) -> None:
        assert self._templates is not None
        place = triangulate(self.rig, left, right).mean(0)
        speed, std = self.vehicle.speed or float("nan"), float("nan")
        if before := next((s for s in reversed(self.frame_results) if s.status == "tracking"), None):
            dt, step = frame.time - before.time, place - before.position
            speed = float(np.linalg.norm(step)) / dt
            ahead = step / max(speed * dt, 1e-12)
            of_step = centroid_covariance(self.rig, place, len(left))
            of_step = of_step + centroid_covariance(self.rig, before.position, int(before.effective_points))
            std = float(np.sqrt(ahead @ of_step @ ahead)) / dt
        self.frame_results.append(
            FrameResult(
                frame=frame.index,
                time=frame.time,
                left=self._templates.quads[0],
                right=self._templates.quads[1],
                status=self._templates.status,
                speed=speed,
                speed_std=std,
                position=place,
                points_left=left,
                points_right=right,
                effective_points=float(len(left)),
            )
        )

    def unmeasurable(self) -> Message:
        """Why the vehicle cannot be measured; empty if it can."""
        if self.frame_results:
            return check_frame_count(self.frame_results, self.limits)
        return message("too_little_texture", test=f"fewer than {MIN_FEATURE_MATCHES} features match across the views")

    def result(self) -> Measurement:
        """The measurement: the mean speed of a polynomial track fitted to the centroids."""
        name = self.vehicle.id
        if reason := self.unmeasurable():
            return rejected(name, self.frame_results, reason)
        tracked = [s for s in self.frame_results if s.status == "tracking"]
        places = np.array([s.position for s in tracked])
        # the centroid scatters with the set of matches, isotropically; the first position is part of all displacements
        count = len(tracked) - 1
        scatter = np.kron(np.eye(count) + np.ones((count, count)), np.eye(3))
        track = polynomial_track.fit_polynomial(np.array([s.time for s in tracked]), places, np.asarray(scatter, float))
        speed, std = track.mean_speed()
        return measurement_of(name, self.frame_results, MeanSpeed(speed, std, track.dof, track.model), self.limits)


def centroid_covariance(rig: StereoRig, place: Array, matches: int) -> Array:
    """Covariance (3, 3), m², of the centroid of this number of independent ``matches`` near ``place`` (3,)."""
    return triangulation_covariance(rig, place, FEATURE_MATCH_SIGMA_PX) / matches


def features_inside(detector: cv2.SIFT, image: Image, quad: Array) -> tuple[Array, Descriptors]:
    """SIFT features (n, 2) px of ``image`` inside ``quad`` (4, 2), and their descriptors (n, 128)."""
    x0, y0 = np.maximum(np.floor(quad.min(0)).astype(int) - DESCRIPTOR_MARGIN_PX, 0)
    x1, y1 = np.ceil(quad.max(0)).astype(int) + 1 + DESCRIPTOR_MARGIN_PX
    picture = image[y0:y1, x0:x1]
    mask = np.zeros(picture.shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(quad - [x0, y0]).astype(np.int32), 255)
    places, descriptors = detect_features(detector, picture, mask)
    return places + [x0, y0], descriptors


register("sift", by_vehicle(lambda clip, vehicle, path, c: Sift(clip.rig, vehicle, c.limits)))
