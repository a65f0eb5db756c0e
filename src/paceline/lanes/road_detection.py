"""From an empty road to its lines on one surface."""

from __future__ import annotations

from paceline.blas import on_one_blas_thread
from paceline.cameras import StereoRig
from paceline.lanes.ground_plane import first_surface
from paceline.lanes.line_adjustment import Road, match
from paceline.lanes.line_detection import as_votes, trace
from paceline.lanes.road_direction import find_course
from paceline.lanes.road_rectification import unroll
from paceline.recordings.background import Background
from paceline.verdicts import Message, message

ROUNDS = 3  # of tracing the lines and adjusting the surface to them


class NoRoad(Exception):
    """No road was found, for a ``reason``."""

    def __init__(self, reason: Message) -> None:
        super().__init__(reason)
        self.reason = reason


@on_one_blas_thread
def find_road(rig: StereoRig, background: Background) -> Road:
    """The lines that both views show on the road's surface. Raises `NoRoad`."""
    surface = first_surface(rig, background)
    if surface is None:
        raise NoRoad(message("no_ground"))
    course = find_course(rig, background, surface)
    if course is None:
        raise NoRoad(message("no_painted_lines"))
    road: Road | None = None
    for _ in range(ROUNDS):
        course = as_votes(unroll(rig, background, surface, course), course).polish(course)
        lines = trace(rig, surface, course, unroll(rig, background, surface, course))
        if not lines:
            raise NoRoad(message("lines_too_short"))
        road = match(rig, surface, course, lines)
        if road is None:
            raise NoRoad(message("lines_along_baseline"))
        surface, course = road.surface, road.common_course
    assert road is not None, "there is at least one round"
    return road
