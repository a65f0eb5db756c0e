"""Search for the vehicles of a recorded clip that outlines none."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import islice

from paceline.blas import on_one_blas_thread
from paceline.detection.background_model import (
    BackgroundModel,
    DetectBoxes,
    DetectorBackground,
    RunningMedianBackground,
)
from paceline.detection.finder import DetectedVehicle, VehicleFinder
from paceline.detection.lane_paths import lane_paths_of
from paceline.documents.loading import Clip, PathDocument
from paceline.imaging.recorded_cameras import estimate_cameras
from paceline.lanes.lane_proposals import propose_lanes
from paceline.lanes.road_detection import RoadNotFound, detect_road
from paceline.lanes.site_yaml import lane_names
from paceline.progress import Progress
from paceline.recordings.background import Background, background_problem, estimate_background
from paceline.recordings.stereo import StereoRecording
from paceline.speed.configuration import DEFAULTS, SpeedConfiguration
from paceline.speed.measurement import require_two_views
from paceline.verdicts import NO_REASON, Message, message


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The ``clip`` with the vehicles (and, where it had none, the paths) that were found, all ``detected`` vehicles in
    order of appearance, and the ``reason`` where there is none to measure."""

    clip: Clip
    detected: list[DetectedVehicle]
    reason: Message
    camera_notices: list[Message] = field(default_factory=list)

    @property
    def notices(self) -> list[str]:
        """One line for each vehicle that cannot be measured or told from another, and for there being none."""
        messages: list[str] = [
            message("vehicle_not_measured", path=f.path, start=f.times[0], end=f.times[1], reason=f.reason)
            for f in self.detected
            if f.vehicle is None
        ]
        messages += [notice for f in self.detected for notice in f.notices] + self.camera_notices
        return messages + ([self.reason.after("no vehicle was found")] if self.reason else [])


@on_one_blas_thread
def find_vehicles(
    clip: Clip,
    recording: StereoRecording,
    progress: Progress | None = None,
    detect: DetectBoxes | None = None,
    configuration: SpeedConfiguration = DEFAULTS,
) -> SearchResult:
    """The vehicles that drive along the paths of ``clip``, or along its lanes where it has no paths, called v0, v1, …
    in order of appearance.

    It reads the recording twice: some frames for the background, then all of them. With ``detect``, vehicles are found
    only inside its boxes, and the background is not estimated where the clip has paths. Raises UnusableInput for a
    recording that cannot be used, and a path that its drawing does not determine.
    """
    first, *second = islice(recording.frames(), 1 if detect is None else 2)
    require_two_views(clip, first)
    model: BackgroundModel | None = None
    if detect is not None:
        model = DetectorBackground(detect)
        for frame in second:
            model.update(frame)  # from which the noise of the first is estimated
    if model is None or not clip.paths:
        background = estimate_background(recording, configuration.background.frames, progress)
        if reason := background_problem(background):
            return SearchResult(clip, [], reason)
        if not clip.paths:
            try:
                clip = with_detected_lanes(clip, background, configuration.lanes.width)
            except RoadNotFound as error:
                return SearchResult(clip, [], error.reason.after("there are no paths, and no lane was found"))
        model = model or RunningMedianBackground(background.images)
    finder, detected = VehicleFinder(lane_paths_of(clip, configuration.line_sigma), model, configuration), []
    for count, frame in enumerate(recording.frames(), start=1):
        detected += finder.process(frame)
        if progress:
            progress(count, len(recording))
    detected = number_vehicles(detected + finder.finish())
    vehicles = [f.vehicle for f in detected if f.vehicle is not None]
    return SearchResult(replace(clip, vehicles=vehicles), detected, NO_REASON if vehicles else model.no_vehicle_reason)


def find_recorded_vehicles(
    clip: Clip,
    recording: StereoRecording,
    progress: Progress | None = None,
    detect: DetectBoxes | None = None,
    configuration: SpeedConfiguration = DEFAULTS,
) -> SearchResult:
    """As `find_vehicles`, by cameras that are corrected for what the ``recording`` tells of them, as those of a
    measurement are: when the views were exposed, how the cameras turn, how well the calibration holds. Outlines are
    where the pictures as recorded show them."""
    cameras = estimate_cameras(replace(clip, vehicles=[]), recording, progress)
    search = find_vehicles(cameras.clip, cameras.recording, progress, detect, configuration)
    recorded = cameras.with_recorded_outlines(search.clip, recording).vehicles
    clip = replace(clip, paths=search.clip.paths, vehicles=recorded)
    outlines = {v.id: v for v in recorded}
    detected = [f if f.vehicle is None else replace(f, recorded=outlines[f.vehicle.id]) for f in search.detected]
    return replace(search, clip=clip, detected=detected, camera_notices=cameras.notices)


def number_vehicles(detected: list[DetectedVehicle]) -> list[DetectedVehicle]:
    """``detected`` in order of appearance, those with an outline called v0, v1, …"""
    ordered: list[DetectedVehicle] = []
    count = 0
    for f in sorted(detected, key=lambda f: (f.times[0], float(f.position[2]), float(f.position[0]))):
        if f.vehicle is not None:
            f = replace(f, vehicle=replace(f.vehicle, id=f"v{count}"))
            count += 1
        ordered.append(f)
    return ordered


def with_detected_lanes(clip: Clip, background: Background, widths: tuple[float, float] = DEFAULTS.lanes.width) -> Clip:
    """``clip`` with the lanes of its road, of these least and greatest ``widths`` in m, as paths. Raises
    `RoadNotFound`."""
    proposed, _ = propose_lanes(clip.rig, detect_road(clip.rig, background), widths)
    lanes = [lane for lane in proposed if lane.path is not None]
    if not lanes:
        raise RoadNotFound(message("no_lane_between_lines"))
    paths = {
        name: PathDocument(
            name,
            "line" if lane.shape == "line" else "curve",
            clip.rig.left.undistort_points(lane.left),
            clip.rig.right.undistort_points(lane.right),
            0.0,
            None,
        )
        for name, lane in zip(lane_names(len(lanes)), lanes, strict=True)
    }
    return replace(clip, paths=paths)
