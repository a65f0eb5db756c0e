"""What both views would show without vehicles: the empty scene, as it changes with the light and with what comes to
stand in it, or else all that a detector takes for no vehicle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Image
from paceline.cameras import ALL_ROWS
from paceline.detection import background_model_cpu
from paceline.detection.detector import noise_of
from paceline.recordings.stereo import StereoFrame
from paceline.verdicts import Message, message

Detect = Callable[[Image], NDArray[np.float64]]  # a picture (H, W): left, top, right, bottom (N, 4), px

DRIFT = 2.0  # grey levels per second by which a scene follows what is seen
WIDER = 0.05  # of a box's size, on either side: detectors clip bumpers


@dataclass(frozen=True, eq=False)
class Before:
    """Both views (H, W) with what there was before any vehicle; the ``noise`` of the left view, grey levels, where its
    difference from it does not tell it."""

    images: tuple[Image, Image]
    noise: float | None = None


class Scene(Protocol):
    """What is there without vehicles."""

    def before(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> Before:
        """What ``frame`` would show, of which only the ``rows`` are looked at."""

    def follow(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> None:
        """Take note of what ``frame`` shows."""

    @property
    def nothing(self) -> Message:
        """Why no vehicle was found, where that is so."""


class EmptyScene:
    """Both views of the scene behind the traffic; each frame pulls every pixel a little towards what it shows.

    The pull does not grow with the difference, so that a vehicle that passes leaves no trace: what is followed is the
    running median.
    """

    def __init__(self, images: tuple[Image, Image]) -> None:
        self.images = (images[0].copy(), images[1].copy())
        self._time: float | None = None

    def before(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> Before:
        """The same for every frame."""
        return Before(self.images)

    def follow(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> None:
        """Draw the scene, or only its ``rows``, towards what ``frame`` shows."""
        if self._time is not None:
            step = DRIFT * (frame.time - self._time)
            for image, now in zip(self.images, (frame.left, frame.right), strict=True):
                background_model_cpu.draw(image[rows], now[rows], step)
        self._time = frame.time

    @property
    def nothing(self) -> Message:
        """Why no vehicle was found, where that is so."""
        return message("no_vehicle_detected")


class DetectedScene:
    """Both views as they are where ``detect`` finds no vehicle; in its boxes nothing is as it was before."""

    def __init__(self, detect: Detect) -> None:
        self._detect = detect
        self._last: Image | None = None
        self._pictures = self._boxed = 0

    def before(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> Before:
        """With the noise by which ``frame`` differs from the last one; none for the first frame."""
        boxes = self._detect(frame.left), self._detect(frame.right)
        self._pictures += 2
        self._boxed += sum(len(of) > 0 for of in boxes)
        images = _outside(frame.left, boxes[0]), _outside(frame.right, boxes[1])
        if self._last is None:
            return Before(images)
        return Before(images, noise_of(frame.left[rows], self._last[rows]) / float(np.sqrt(2.0)))

    def follow(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> None:
        """Remember ``frame`` to tell the noise of the next one."""
        self._last = frame.left

    @property
    def nothing(self) -> Message:
        """Why no vehicle was found, where that is so."""
        if not self._boxed:
            return message("detector_saw_none", images=self._pictures)
        return message("detector_none_on_paths", detected=self._boxed, images=self._pictures)


def _outside(view: Image, boxes: NDArray[np.float64]) -> Image:
    """A ``view`` (H, W), but its negative about their mean in the ``boxes`` (N, 4), with which nothing agrees."""
    before, size = view.copy(), np.array(view.shape[::-1])
    for box in boxes:
        more = WIDER * (box[2:] - box[:2])
        left, top = np.floor(np.clip(box[:2] - more, 0, size)).astype(int)
        right, bottom = np.ceil(np.clip(box[2:] + more, 0, size)).astype(int)
        part = np.s_[top:bottom, left:right]
        if view[part].size:
            before[part] = 2 * view[part].mean() - view[part]
    return before
