"""The items of [NIST], their chases, each drawn by a seed, and a tracker on them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from follow import OFF_PLACE, OFF_RANGE, SEEN, operators_start
from numpy.typing import NDArray
from zhu2012.reproductions import Numbers, Reproduction

from paceline.follow.configuration import FollowConfiguration
from paceline.follow.results import FollowEstimate
from paceline.follow.tracker import FollowTracker
from paceline.recordings.odometry import Pose
from paceline.simulation.chase.clip import ChaseScene, ChaseTruth, render_frames

Image = NDArray[np.uint8]


def item(
    script: str,
    title: str,
    settings: Numbers,
    compute: Callable[[], Numbers],
    text: Callable[[Numbers], str],
    draw: Callable[[Numbers, Path], None] | None = None,
    picture: str | None = None,
    rooms: tuple[str, ...] = ("follow",),
) -> Reproduction:
    """An item with one ``picture`` or none, whose numbers hang on the ``rooms`` of the package and on this module."""
    return Reproduction(
        name=f"nist-{script}",
        script=f"nist1993.{script}",
        title=f"[NIST] {title}",
        compute=compute,
        text=text,
        draw=draw,
        pictures=() if picture is None else (picture,),
        settings=settings,
        rooms=rooms,
        helpers=(sys.modules[__name__],),
    )


@dataclass
class Verdicts:
    """Frames that show the vehicle: in all, without a track, and with a track that is far off."""

    frames: int = 0
    lost: int = 0
    wrong: int = 0

    def add(self, e: FollowEstimate, truth: ChaseTruth, width: float) -> None:
        if truth.visible < SEEN:
            return
        self.frames += 1
        if e.status != "tracking":
            self.lost += 1
            return
        far = truth.position[2]
        off = np.linalg.norm(e.center - truth.center)
        self.wrong += bool(abs(e.position[2] - far) > OFF_RANGE * far or off > OFF_PLACE * width)

    @property
    def shares(self) -> dict[str, float]:
        """Per cent."""
        return {"lost": 100 * self.lost / self.frames, "wrong": 100 * self.wrong / self.frames}


def followed(
    scene: ChaseScene, configurations: dict[str, FollowConfiguration]
) -> Iterator[tuple[Image, ChaseTruth, dict[str, FollowEstimate]]]:
    """Picture after picture with its truth and what a tracker of each configuration makes of it."""
    trackers: dict[str, FollowTracker] = {}
    for image, truth in render_frames(scene):
        if not trackers:
            start = operators_start(scene, truth)
            trackers = {name: FollowTracker(scene.camera, *start, c) for name, c in configurations.items()}
        pose = Pose(truth.x, truth.y, truth.heading)
        yield image, truth, {name: t.update(image, truth.time, truth.frame, pose) for name, t in trackers.items()}


def judged(scenes: list[ChaseScene], configurations: dict[str, FollowConfiguration]) -> dict[str, Verdicts]:
    """The verdicts of each configuration over all ``scenes``."""
    verdicts = {name: Verdicts() for name in configurations}
    for scene in scenes:
        for _, truth, estimates in followed(scene, configurations):
            width = float(np.linalg.norm(truth.corners[1] - truth.corners[0]))
            for name, e in estimates.items():
                verdicts[name].add(e, truth, width)
    return verdicts
