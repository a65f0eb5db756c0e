"""Vehicles in a recording of a stationary rig, frame by frame: detection, tracking, and an outline of each vehicle."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from paceline.arrays import Array, Image
from paceline.detection.abreast import separated
from paceline.detection.background_model import BackgroundModel
from paceline.detection.detector import Detection, PlaneSweepDetector
from paceline.detection.face_height import select_height
from paceline.detection.lane_paths import LanePath
from paceline.detection.planar_face import (
    AlignedDetection,
    PlanarFace,
    face_positions,
    find_face,
    nearer_half,
    similarity,
    with_visible_face,
)
from paceline.detection.track_motion import MIN_TRAVEL_M_PX, TrackMotion
from paceline.detection.tracks import DetectionTrack, TrackAssociator, motion_residuals
from paceline.documents.loading import VehicleDocument
from paceline.recordings.stereo import StereoFrame
from paceline.robust_line import theil_sen_slope
from paceline.speed.configuration import DEFAULTS, SpeedConfiguration
from paceline.verdicts import NO_REASON, Message, message

MIN_DETECTIONS = 4  # of a vehicle, plus half the frames without one between them, which must not be more than they
# of a vehicle, and of one that has travelled more than `LONG_TRAVEL_M`: above, two objects were detected in turn, such
# as bushes in the wind
MAX_UNSTEADINESS = 0.4, 0.5
LONG_TRAVEL_M = 10.0
MAX_SMOOTH_ROUGHNESS_PX, MIN_SMOOTH_DETECTIONS = 0.5, 8  # of a track whose unsteadiness only has to be below 1
MAX_LATERAL_OFFSET_M = 1.9  # from the middle of the lane, of this
LATERAL_OFFSET_QUANTILE = 0.25  # quantile of the detections: a vehicle may be changing lanes
# median consistent area times the root of the number of detections: two lamps in the dark are small, but detected again
# and again
MIN_VEHICLE_AREA_M2 = 0.7
MAX_COUNTED_DETECTIONS = 16  # of that number
MIN_VEHICLE_HEIGHT_M = 0.8  # of a vehicle above the road: what is lower is a shadow,
MIN_LOW_UPRIGHT_RATIO = 10.0  # unless its upright ratio is as high as this: lamps in the dark
# median over the track: two shadows one behind the other reached 2.0; of 260 vehicles by day the lowest was 4.4, at
# night 2.9
MIN_TRACK_UPRIGHT_RATIO = 2.5
MOTION_ERROR_M_PX = 1.0, 1.0  # greatest error of an aligned detection along the lane, m, or px of disparity if more
MAX_COUNTED_RESIDUAL = 2.0  # in such errors, up to which a residual counts against a motion
IGNORED_ERROR_FACTOR = 1e3  # by which the error of a detection is multiplied that shall not influence the motion
RECENT_VEHICLES = 8  # number of latest vehicles in a lane to which a further track may belong
MIN_SIMILARITY_RATIO = 0.9  # of the frame of the outline to the median: nothing hides the face there
MIN_BORDER_PX = 4.0  # least distance between an outline and the edge of the image


@dataclass(frozen=True, eq=False)
class DetectedVehicle:
    """A vehicle that has passed, with its outline as clip.yaml holds it, ``vehicle``, or None and a ``reason`` where it
    has no part that could be measured.

    ``path`` is the name of its path, ``times`` (2,) when it was first and last detected, s; ``width`` and ``height``
    are those of its visible part, m; ``position`` (3,) m is where on the road it was first detected; ``crops`` of both
    views in the frame of the outline begin at the pixels ``crop_origins`` (2, 2). ``notices`` say what is doubtful;
    ``recorded`` is the outline in the pictures as recorded, where those that were searched are corrected ones.
    """

    path: str
    times: tuple[float, float]
    width: float
    height: float
    position: Array
    vehicle: VehicleDocument | None
    reason: Message
    crops: tuple[Image, Image]
    crop_origins: Array
    notices: tuple[Message, ...] = ()
    recorded: VehicleDocument | None = None


class VehicleFinder:
    """Finds vehicles along the lanes of a stationary rig::

        finder = VehicleFinder(lanes, background)
        for frame in recording.frames():
            for vehicle in finder.process(frame):
                ...
        finder.finish()

    Memory does not grow with the recording.
    """

    def __init__(
        self, lanes: list[LanePath], background: BackgroundModel, configuration: SpeedConfiguration = DEFAULTS
    ) -> None:
        self._detector = PlaneSweepDetector(lanes, configuration.detection)
        self._associator, self._background, self._configuration = TrackAssociator(), background, configuration
        self._duplicates = DuplicateFilter()

    @property
    def rows(self) -> slice:
        """The rows of the images that are used."""
        return self._detector.rows

    def process(self, frame: StereoFrame) -> list[DetectedVehicle]:
        """The vehicles that have passed by the time of ``frame``."""
        return self._outline_new(self.finished_tracks(frame))

    def finish(self) -> list[DetectedVehicle]:
        """The vehicles that were still visible in the last frame."""
        return self._outline_new(self.remaining_tracks())

    def _outline_new(self, tracks: list[DetectionTrack]) -> list[DetectedVehicle]:
        both = [(track, outline(track, self._configuration)) for track in tracks]
        return [detected for track, detected in both if self._duplicates.is_new(track, detected)]

    def finished_tracks(self, frame: StereoFrame) -> list[DetectionTrack]:
        """As `process`, but the tracks only, for which `outline` has yet to find what can be measured: that takes
        longer than a frame lasts, and a live program leaves it to another process."""
        if frame.duplicate:
            return []
        background = self._background.background(frame, self.rows)
        detections = self._detector.detect(frame, background.images, background.noise)
        if not background.is_road:
            detections = [replace(detection, is_road_known=False) for detection in detections]
        self._background.update(frame, self.rows)
        finished = [track for track in self._associator.associate(frame.time, detections) if may_be_vehicle(track)]
        passed = [t for t in finished if not any(continued_by(t, other) for other in self._associator.tracks)]
        return [vehicle for track in passed for vehicle in vehicles_of(track)]

    @property
    def visible_tracks(self) -> list[DetectionTrack]:
        """The tracks of what moves along the lanes in the last frame, and may be a vehicle."""
        return [track for track in self._associator.tracks if not track.frames_unseen and track.is_moving]

    def remaining_tracks(self) -> list[DetectionTrack]:
        """As `finish`, but the tracks only."""
        tracks, self._associator = self._associator.tracks, TrackAssociator()
        return [vehicle for track in tracks if may_be_vehicle(track) for vehicle in vehicles_of(track)]


class DuplicateFilter:
    """The last vehicles that were found in each lane, so that none is reported twice: at night two lamps, or the glow
    about a lamp and the lamp, may be followed by a track each, and what stands for long is found again."""

    def __init__(self) -> None:
        self._recent: dict[LanePath, deque[DetectionTrack]] = {}

    def is_new(self, track: DetectionTrack, detected: DetectedVehicle) -> bool:
        """Whether the vehicle ``detected`` on a ``track`` is none of those; one with an outline is added to them."""
        if any(track.same_vehicle(other) for recent in self._recent.values() for other in recent):
            return False
        if detected.vehicle is not None:
            self._recent.setdefault(track.first.lane, deque(maxlen=RECENT_VEHICLES)).append(track)
        return True


def is_vehicle(track: DetectionTrack, min_upright_ratio: float = MIN_TRACK_UPRIGHT_RATIO) -> bool:
    """Whether what was tracked is large enough and as upright as ``min_upright_ratio``, and drives along its lane, all
    the time or between two stands."""
    if len(track.times) < max(MIN_DETECTIONS + track.frames_missed / 2, track.frames_missed):
        return False
    offsets = np.abs([s.lateral_offset for s in track.kept])
    nearest = float(np.quantile(offsets, LATERAL_OFFSET_QUANTILE))
    if nearest > MAX_LATERAL_OFFSET_M or len(with_visible_face(track)) < 2:
        return False
    motion = track.motion
    parts = [slice(0, len(track.times))] * motion.exceeds(MIN_TRAVEL_M_PX) + motion.drives()
    return any(_is_upright(track, part, min_upright_ratio) and _drives(motion.part(part)) for part in parts)


def may_be_vehicle(track: DetectionTrack) -> bool:
    """Whether what was tracked is a vehicle, or drives as one and is as large, but may lie on the road."""
    return is_vehicle(track, min_upright_ratio=0.0)


def _is_upright(track: DetectionTrack, part: slice, min_upright_ratio: float) -> bool:
    """Whether a ``part`` of the detections of a ``track`` is of something upright that is large enough."""
    areas, ratios = track.areas[part], track.upright_ratios[part]
    area = float(np.median(areas)) * np.sqrt(min(len(areas), MAX_COUNTED_DETECTIONS))
    upright_ratio, is_low = float(np.median(ratios)), _height(track) < MIN_VEHICLE_HEIGHT_M
    least = max(min_upright_ratio, MIN_LOW_UPRIGHT_RATIO if is_low else 0.0)
    return len(areas) >= MIN_DETECTIONS and area >= MIN_VEHICLE_AREA_M2 and upright_ratio >= least


def _drives(motion: TrackMotion) -> bool:
    """Whether a ``motion`` that covers some distance is that of a vehicle."""
    smooth = len(motion.times) >= MIN_SMOOTH_DETECTIONS and motion.roughness_px < MAX_SMOOTH_ROUGHNESS_PX
    return motion.unsteadiness < (1.0 if smooth else MAX_UNSTEADINESS[abs(motion.travel) > LONG_TRAVEL_M])


def vehicles_of(track: DetectionTrack) -> list[DetectionTrack]:
    """The tracks of two vehicles abreast that are one ``track``, where each is a vehicle by itself; else that alone."""
    both = separated(track)
    if len(both) == 1 or all(is_vehicle(one) for one in both):
        return both
    track.may_be_two = True
    return [track]


def continued_by(track: DetectionTrack, other: DetectionTrack) -> bool:
    """Whether the vehicle of a ``track`` that has ended is followed for longer by ``other``."""
    return len(other.times) > len(track.times) and is_vehicle(other) and other.same_vehicle(track)


def without_outline(track: DetectionTrack, reason: Message) -> DetectedVehicle:
    """The vehicle of a ``track``, without an outline for a ``reason``."""
    first = track.first
    return DetectedVehicle(
        path=first.lane.name,
        times=(track.times[0], track.times[-1]),
        width=track.width,
        height=_height(track),
        position=first.position,
        vehicle=None,
        reason=reason,
        crops=first.crops,
        crop_origins=first.crop_origins,
        notices=(message("vehicles_not_told_apart", path=first.lane.name, start=track.times[0], end=track.times[-1]),)
        if track.may_be_two
        else (),
    )


def outline(track: DetectionTrack, configuration: SpeedConfiguration = DEFAULTS) -> DetectedVehicle:
    """The vehicle of a ``track`` with its outline in the first frame that shows it well; where all detections give
    none, from the nearer half, because farther away another vehicle may hide most of it."""
    if not is_vehicle(track):
        ratio = float(np.median(track.upright_ratios))
        reason = message("may_be_shadow", upright_ratio=ratio, min_upright_ratio=MIN_TRACK_UPRIGHT_RATIO)
        return without_outline(track, reason)
    detections = with_visible_face(track)
    detected = _outline_from(track, detections, configuration)
    if detected.vehicle is not None or not detections:
        return detected
    nearer = _outline_from(track, nearer_half(detections), configuration)
    return detected if nearer.vehicle is None else nearer


def _outline_from(
    track: DetectionTrack, detections: list[Detection], configuration: SpeedConfiguration
) -> DetectedVehicle:
    """The vehicle of a ``track``, with its outline from some of its ``detections``."""
    face = find_face(detections)
    if face is None:
        return without_outline(track, message("no_planar_face"))
    inliers, min_size = motion_inliers(face.aligned), configuration.detection.min_size_px
    clear = [aligned for aligned in inliers if _is_clear(face, aligned, min_size)]
    if not clear:
        reason = message("face_never_clear", min_width_px=min_size[0], min_height_px=min_size[1])
        return without_outline(track, reason)
    similarities = similarity(face, clear)
    first = clear[int(np.argmax(similarities >= MIN_SIMILARITY_RATIO * np.median(similarities)))]
    later_detections = inliers[inliers.index(first) :]
    face = select_height(
        face, later_detections, partial(_is_clear, aligned=first, min_size=min_size), configuration.driver
    )
    detection = first.detection
    left, right = detection.lane.pixels(first.s, face.corners(first))
    speed = initial_speed(later_detections, configuration.start.speed_range[0])
    document = VehicleDocument("", detection.lane.name, detection.frame, left, right, "front", speed)
    return replace(
        without_outline(track, NO_REASON),
        path=detection.lane.name,
        vehicle=document,
        crops=detection.crops,
        crop_origins=detection.crop_origins,
    )


def _height(track: DetectionTrack) -> float:
    return float(np.median([s.y[1] for s in track.kept]))


def motion_inliers(aligned: list[AlignedDetection]) -> list[AlignedDetection]:
    """The ``aligned`` detections on the motion of all, or of all but one: an outlier at an end would bend the motion
    towards itself."""
    t, s = face_positions(aligned)
    error = np.array([a.detection.distance_error(*MOTION_ERROR_M_PX) for a in aligned])
    factors = np.where(np.eye(len(t)), IGNORED_ERROR_FACTOR, 1.0)
    motions = [motion_residuals(t, s, error), *(factor * motion_residuals(t, s, factor * error) for factor in factors)]
    best = min(motions, key=lambda residuals: float(np.minimum(np.abs(residuals), MAX_COUNTED_RESIDUAL).sum()))
    return [a for a, residual in zip(aligned, best, strict=True) if abs(residual) <= 1]


def initial_speed(detections: list[AlignedDetection], slowest: float = DEFAULTS.start.speed_range[0]) -> float | None:
    """A first guess of the speed, m/s, from the first half of the ``detections``; None where these are too few, or it
    is below ``slowest``."""
    first_detections = detections[: max(MIN_DETECTIONS, len(detections) // 2)]
    if len(first_detections) < MIN_DETECTIONS:
        return None
    speed = round(abs(theil_sen_slope(*face_positions(first_detections))), 1)
    return speed if speed >= slowest else None


def _is_clear(face: PlanarFace, aligned: AlignedDetection, min_size: tuple[float, float]) -> bool:
    """Whether a face has ``min_size`` px, width and height, in a frame and is wholly inside both images."""
    lane = aligned.detection.lane
    for quad, camera in zip(lane.pixels(aligned.s, face.corners(aligned)), lane.rig.cameras, strict=True):
        inside = (quad >= MIN_BORDER_PX) & (quad <= np.array(camera.image_size) - 1 - MIN_BORDER_PX)
        if not inside.all() or (np.ptp(quad, axis=0) < min_size).any():
            return False
    return True
