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

ROUNDS = 3  # of tracing the lines and adjusting the surface to them


class NoRoad(Exception):
    """No road was found; the message says why, for the person who filmed it."""


@on_one_blas_thread
def find_road(rig: StereoRig, background: Background) -> Road:
    """The lines that both views show on the road's surface. Raises `NoRoad`."""
    surface = first_surface(rig, background)
    if surface is None:
        raise NoRoad("no ground was found: the two views do not match below the cameras; check the rig first")
    course = find_course(rig, background, surface)
    if course is None:
        raise NoRoad("nothing on the ground looks like painted lines in both views")
    road: Road | None = None
    for _ in range(ROUNDS):
        course = as_votes(unroll(rig, background, surface, course), course).polish(course)
        lines = trace(rig, surface, course, unroll(rig, background, surface, course))
        if not lines:
            raise NoRoad("no painted line runs along the road for long enough in both views")
        road = match(rig, surface, course, lines)
        if road is None:
            raise NoRoad(
                "the painted lines run along the line between the cameras, so the two views do not determine them in "
                "space; film the road more along its course"
            )
        surface, course = road.surface, road.common_course
    assert road is not None, "there is at least one round"
    return road
