"""Detection of a road in the background image: its painted lines on one surface."""

from __future__ import annotations

from paceline.blas import on_one_blas_thread
from paceline.cameras import StereoRig
from paceline.lanes.ground_plane import initial_surface
from paceline.lanes.line_adjustment import RoadModel, adjust
from paceline.lanes.line_detection import detect_lines, direction_votes
from paceline.lanes.road_direction import estimate_direction
from paceline.lanes.road_rectification import rectify
from paceline.recordings.background import Background
from paceline.verdicts import Message, message

ADJUSTMENT_ROUNDS = 3  # rounds of line detection and adjustment


class RoadNotFound(Exception):
    """No road was found, for a ``reason``."""

    def __init__(self, reason: Message) -> None:
        super().__init__(reason)
        self.reason = reason


@on_one_blas_thread
def detect_road(rig: StereoRig, background: Background) -> RoadModel:
    """The lines that both views show on the road's surface. Raises `RoadNotFound`."""
    surface = initial_surface(rig, background)
    if surface is None:
        raise RoadNotFound(message("no_ground"))
    alignment = estimate_direction(rig, background, surface)
    if alignment is None:
        raise RoadNotFound(message("no_painted_lines"))
    road: RoadModel | None = None
    for _ in range(ADJUSTMENT_ROUNDS):
        alignment = direction_votes(rectify(rig, background, surface, alignment), alignment).refine(alignment)
        lines = detect_lines(rig, surface, alignment, rectify(rig, background, surface, alignment))
        if not lines:
            raise RoadNotFound(message("lines_too_short"))
        road = adjust(rig, surface, alignment, lines)
        if road is None:
            raise RoadNotFound(message("lines_along_baseline"))
        surface, alignment = road.surface, road.common_alignment
    assert road is not None, "there is at least one round"
    return road
