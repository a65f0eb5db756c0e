"""From a clip in which nothing is outlined to the vehicles in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice

from paceline.blas import on_one_blas_thread
from paceline.detection.background_model import Detect, DetectedScene, EmptyScene, Scene
from paceline.detection.finder import Finder, Found
from paceline.detection.lane_paths import ways_of
from paceline.documents.loading import Clip, PathDocument
from paceline.lanes.lane_proposals import propose
from paceline.lanes.road_detection import NoRoad, find_road
from paceline.lanes.site_yaml import lane_names
from paceline.progress import Progress
from paceline.recordings.background import Background, empty_scene, no_background
from paceline.recordings.stereo import StereoRecording
from paceline.speed.measurement import require_two_views
from paceline.verdicts import NO_REASON, Message, message


@dataclass(frozen=True, eq=False)
class Search:
    """What was found in a clip: the ``clip`` with the vehicles (and, where it had none, the paths) in it, all ``found``
    in order of appearance, and the ``reason`` where there is no vehicle to measure."""

    clip: Clip
    found: list[Found]
    reason: Message

    @property
    def notices(self) -> list[str]:
        """One line for each vehicle that cannot be measured, and for there being none."""
        missed: list[str] = [
            message("vehicle_not_measured", path=f.path, start=f.times[0], end=f.times[1], reason=f.reason)
            for f in self.found
            if f.vehicle is None
        ]
        return missed + ([self.reason.after("no vehicle was found")] if self.reason else [])


@on_one_blas_thread
def find_vehicles(
    clip: Clip, recording: StereoRecording, progress: Progress | None = None, detect: Detect | None = None
) -> Search:
    """The vehicles that drive along the paths of ``clip``, or along the lanes found in it where it has no paths, called
    v0, v1, … in the order in which they appear.

    It goes through the recording twice: some frames of it for the empty scene, then all of them. With ``detect`` there
    are vehicles only in its boxes, and the empty scene is left out where the clip has paths. Raises UnusableInput for a
    recording that cannot be used, and a path that its drawing does not determine.
    """
    first, *second = islice(recording.frames(), 1 if detect is None else 2)
    require_two_views(clip, first)
    scene: Scene | None = None
    if detect is not None:
        scene = DetectedScene(detect)
        for frame in second:
            scene.follow(frame)  # tells the noise of the first
    if scene is None or not clip.paths:
        background = empty_scene(recording, progress)
        if reason := no_background(background):
            return Search(clip, [], reason)
        if not clip.paths:
            try:
                clip = with_lanes_found(clip, background)
            except NoRoad as error:
                return Search(clip, [], error.reason.after("there are no paths, and no lane was found"))
        scene = scene or EmptyScene(background.images)
    finder, found = Finder(ways_of(clip), scene), []
    for count, frame in enumerate(recording.frames(), start=1):
        found += finder.see(frame)
        if progress:
            progress(count, len(recording))
    found = in_order(found + finder.finish())
    vehicles = [f.vehicle for f in found if f.vehicle is not None]
    return Search(replace(clip, vehicles=vehicles), found, NO_REASON if vehicles else scene.nothing)


def in_order(found: list[Found]) -> list[Found]:
    """``found`` in the order in which the vehicles appeared, those to measure called v0, v1, …"""
    ordered: list[Found] = []
    count = 0
    for f in sorted(found, key=lambda f: (f.times[0], float(f.place[2]), float(f.place[0]))):
        if f.vehicle is not None:
            f = replace(f, vehicle=replace(f.vehicle, id=f"v{count}"))
            count += 1
        ordered.append(f)
    return ordered


def with_lanes_found(clip: Clip, background: Background) -> Clip:
    """``clip`` with the lanes of its road as paths. Raises `NoRoad`."""
    lanes = [lane for lane in propose(clip.rig, find_road(clip.rig, background))[0] if lane.path is not None]
    if not lanes:
        raise NoRoad(message("no_lane_between_lines"))
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
