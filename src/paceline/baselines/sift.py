"""Feature triangulation, as [Zhu] section V compares with: SIFT matches across the views, optimally triangulated, whose
centroid's displacement between frames is the velocity."""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.baselines import polynomial_track
from paceline.baselines.template_tracking import Regions
from paceline.baselines.track import MeanSpeed, Sight, judged, rejected, too_few, unseen
from paceline.baselines.triangulation_covariance import covariance
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

RATIO = 0.8  # of the distances to the best and the second best descriptor (Lowe 2004)
EPIPOLAR = 1.5  # px from the epipolar line
DEEP = 3.0  # scaled median deviations of inverse depth beyond which a match is a mistake
LEAST_MATCHES = 3
SIGMA = 0.5  # px, of a matched feature ([Zhu] section V)
AROUND = 16  # px of picture about the region, which descriptors may show
FAINTEST = 0.02  # SIFT's threshold of contrast: half of the usual one, as distant vehicles are small


class Sift:
    """One vehicle on its way through the clip."""

    def __init__(self, rig: StereoRig, vehicle: VehicleDocument, limits: Limits) -> None:
        self.rig, self.vehicle, self.limits = rig, vehicle, limits
        self.sights: list[Sight] = []
        self._regions: Regions | None = None
        self._detector = cv2.SIFT.create(contrastThreshold=FAINTEST)

    def process(self, frame: StereoFrame) -> bool:
        """Follow the vehicle into ``frame``; whether it can be followed further."""
        if self._regions is None:
            quads = np.stack([self.vehicle.left, self.vehicle.right])
            try:
                self._regions = Regions(self.rig, quads, frame)
            except np.linalg.LinAlgError:
                return False
        else:
            moves = self._regions.find(frame)
            if moves is None:
                return self._miss(frame)
            quads = np.stack([m(q) for m, q in zip(moves, self._regions.quads, strict=True)])
        left, right = self._matches(frame, quads)
        if len(left) < LEAST_MATCHES:
            return self._miss(frame)
        if self.sights:
            self._regions.accept(quads, frame)
        self._note(frame, left, right)
        return self._regions.status == "tracking"

    def _matches(self, frame: StereoFrame, quads: Array) -> tuple[Array, Array]:
        """Features (n, 2) of the regions ``quads`` (2, 4, 2) that match across the views."""
        (a, of_a), (b, of_b) = (
            inside(self._detector, image, quad) for image, quad in zip((frame.left, frame.right), quads, strict=True)
        )
        i, j = match_descriptors(of_a, of_b, RATIO)
        left, right = a[i], b[j]
        with np.errstate(invalid="ignore"):
            inverse = 1.0 / triangulate(self.rig, left, right)[:, 2]
        good = (np.abs(epipolar_distance(self.rig, left, right)) < EPIPOLAR) & (inverse > 0)
        if good.any():
            off = np.abs(inverse - np.median(inverse[good]))
            least = SIGMA / (self.rig.left.K[0, 0] * self.rig.baseline)
            good &= off < DEEP * max(1.4826 * float(np.median(off[good])), least)
        return left[good], right[good]

    def _miss(self, frame: StereoFrame) -> bool:
        assert self._regions is not None
        if not self.sights:
            return False
        further = self._regions.miss(frame.time)
        self.sights.append(unseen(frame, self._regions))
        return further

    def _note(self, frame: StereoFrame, left: Array, right: Array) -> None:
        assert self._regions is not None
        place = triangulate(self.rig, left, right).mean(0)
        speed, std = self.vehicle.speed or float("nan"), float("nan")
        if before := next((s for s in reversed(self.sights) if s.status == "tracking"), None):
            dt, step = frame.time - before.time, place - before.position
            speed = float(np.linalg.norm(step)) / dt
            ahead = step / max(speed * dt, 1e-12)
            of_step = centroid_covariance(self.rig, place, len(left))
            of_step = of_step + centroid_covariance(self.rig, before.position, int(before.strength))
            std = float(np.sqrt(ahead @ of_step @ ahead)) / dt
        self.sights.append(
            Sight(
                frame=frame.index,
                time=frame.time,
                left=self._regions.quads[0],
                right=self._regions.quads[1],
                status=self._regions.status,
                speed=speed,
                speed_std=std,
                position=place,
                points_left=left,
                points_right=right,
                strength=float(len(left)),
            )
        )

    def unmeasurable(self) -> Message:
        """Why there is nothing to measure by; empty where there is."""
        if self.sights:
            return too_few(self.sights, self.limits)
        return message("too_little_texture", test=f"fewer than {LEAST_MATCHES} features match across the views")

    def result(self) -> Measurement:
        """The measurement: the speed along a smooth way through the centroids."""
        name = self.vehicle.id
        if reason := self.unmeasurable():
            return rejected(name, self.sights, reason)
        seen = [s for s in self.sights if s.status == "tracking"]
        places = np.array([s.position for s in seen])
        # the centroid wanders with the set of matches, alike in all directions, and the first place is in all steps
        count = len(seen) - 1
        wander = np.kron(np.eye(count) + np.ones((count, count)), np.eye(3))
        way = polynomial_track.way_through(np.array([s.time for s in seen]), places, np.asarray(wander, float))
        speed, std = way.mean_speed()
        return judged(name, self.sights, MeanSpeed(speed, std, way.dof, way.model), self.limits)


def centroid_covariance(rig: StereoRig, place: Array, matches: int) -> Array:
    """Covariance (3, 3), m², of the centroid of so many independent ``matches`` about ``place`` (3,)."""
    return covariance(rig, place, SIGMA) / matches


def inside(detector: cv2.SIFT, image: Image, quad: Array) -> tuple[Array, Descriptors]:
    """SIFT features (n, 2) px of ``image`` inside ``quad`` (4, 2), and their descriptors (n, 128)."""
    x0, y0 = np.maximum(np.floor(quad.min(0)).astype(int) - AROUND, 0)
    x1, y1 = np.ceil(quad.max(0)).astype(int) + 1 + AROUND
    picture = image[y0:y1, x0:x1]
    mask = np.zeros(picture.shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(quad - [x0, y0]).astype(np.int32), 255)
    places, descriptors = detect_features(detector, picture, mask)
    return places + [x0, y0], descriptors


register("sift", by_vehicle(lambda clip, vehicle, path, c: Sift(clip.rig, vehicle, c.limits)))
