"""Which detected lanes a clip has a path along already, its site's paths included."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from paceline.detection.lane_paths import PATH_EXTENSION_M, LanePath, lane_paths_of
from paceline.documents.loading import Clip
from paceline.errors import UnusableInput
from paceline.lanes.lane_proposals import Lane
from paceline.speed.geometry.paths import Path
from paceline.verdicts import Message, message

LANE_POSITIONS = 9  # along a lane at which its distance from a path is measured
MAX_DISTANCE_SHARE = 0.25  # of a lane's width: greatest distance of a path along it from its middle


def without_known(lanes: Iterable[Lane], clip: Clip) -> tuple[list[Lane], list[Message]]:
    """Those of the ``lanes`` along which ``clip`` has no path yet, and of each other one which path that is."""
    known_paths = list(determined_paths(clip))
    added, remarks = [], []
    for lane in lanes:
        names = [known.name for known in known_paths if runs_along(lane, known.path)]
        if names:
            first, last = lane.between
            remarks.append(message("lane_known", first=first, last=last, path=names[0]))
        else:
            added.append(lane)
    return added, remarks


def determined_paths(clip: Clip) -> Iterator[LanePath]:
    """The lane paths of ``clip``, on both sides of a path with a lateral offset, without those that their drawing does
    not determine."""
    for name, document in clip.paths.items():
        try:
            yield from lane_paths_of(replace(clip, paths={name: document}))
        except UnusableInput:
            continue


def runs_along(lane: Lane, path: Path) -> bool:
    """Whether ``path`` runs in the ``lane`` where it is drawn, in either direction: mostly near its middle."""
    if lane.path is None:
        return False
    distances = []
    for s in np.linspace(lane.path.s[0], lane.path.s[-1], LANE_POSITIONS):
        point = lane.path.at(np.array(s))
        nearest = path.nearest(point)
        if path.s[0] - PATH_EXTENSION_M <= nearest <= path.s[-1] + PATH_EXTENSION_M:
            distances.append(float(np.linalg.norm(path.at(np.array(nearest)) - point)))
    return bool(distances) and float(np.median(distances)) <= MAX_DISTANCE_SHARE * lane.width
