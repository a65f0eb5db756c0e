"""Background models: the images of both views without vehicles.

Either a running median, which follows changes of the light and objects that are left in the scene, or everything
outside the boxes of an object detector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Image
from paceline.cameras import ALL_ROWS
from paceline.detection import background_model_cpu
from paceline.detection.detector import noise_std
from paceline.recordings.stereo import StereoFrame
from paceline.verdicts import Message, message

DetectBoxes = Callable[[Image], NDArray[np.float64]]  # an image (H, W): left, top, right, bottom (N, 4), px

MAX_CHANGE_GREY_PER_S = 2.0  # greatest change of the running median, grey levels per second
BOX_MARGIN_SHARE = 0.05  # margin on every side as a share of a box's size: detectors clip bumpers


@dataclass(frozen=True, eq=False)
class BackgroundEstimate:
    """The background of both views (H, W) of a frame; ``noise`` is the left view's standard deviation, grey levels,
    where the difference to the background does not yield it. It ``is_road`` where that is known behind vehicles."""

    images: tuple[Image, Image]
    noise: float | None = None
    is_road: bool = True


class BackgroundModel(Protocol):
    """The scene without vehicles."""

    def background(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> BackgroundEstimate:
        """The background of ``frame``, of which only the ``rows`` are used."""

    def update(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> None:
        """Update the model by ``frame``."""

    @property
    def no_vehicle_reason(self) -> Message:
        """Why no vehicle was found, where that is so."""


class RunningMedianBackground:
    """The background of both views as a running median: each frame moves every pixel a little towards its value.

    The step does not grow with the difference, so that a vehicle that passes leaves no trace.
    """

    def __init__(self, images: tuple[Image, Image]) -> None:
        self.images = (images[0].copy(), images[1].copy())
        self._time: float | None = None

    def background(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> BackgroundEstimate:
        """The running median, whatever the frame."""
        return BackgroundEstimate(self.images)

    def update(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> None:
        """Move the running median, or only its ``rows``, towards ``frame``."""
        if self._time is not None:
            step = MAX_CHANGE_GREY_PER_S * (frame.time - self._time)
            for image, current in zip(self.images, (frame.left, frame.right), strict=True):
                background_model_cpu.step_towards(image[rows], current[rows], step)
        self._time = frame.time

    @property
    def no_vehicle_reason(self) -> Message:
        """Why no vehicle was found, where that is so."""
        return message("no_vehicle_detected")


class DetectorBackground:
    """The background given by an object detector: both views as they are outside its boxes, and inside them an image
    with which nothing agrees."""

    def __init__(self, detect: DetectBoxes) -> None:
        self._detect = detect
        self._last: Image | None = None
        self._images = self._boxed = 0

    def background(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> BackgroundEstimate:
        """Its noise is that between ``frame`` and the last one; None for the first frame."""
        boxes = self._detect(frame.left), self._detect(frame.right)
        self._images += 2
        self._boxed += sum(len(image_boxes) > 0 for image_boxes in boxes)
        images = _inverted_in_boxes(frame.left, boxes[0]), _inverted_in_boxes(frame.right, boxes[1])
        if self._last is None:
            return BackgroundEstimate(images, is_road=False)
        noise = noise_std(frame.left[rows], self._last[rows]) / float(np.sqrt(2.0))
        return BackgroundEstimate(images, noise, is_road=False)

    def update(self, frame: StereoFrame, rows: slice = ALL_ROWS) -> None:
        """Keep ``frame`` to estimate the noise of the next one."""
        self._last = frame.left

    @property
    def no_vehicle_reason(self) -> Message:
        """Why no vehicle was found, where that is so."""
        if not self._boxed:
            return message("detector_saw_none", images=self._images)
        return message("detector_none_on_paths", detected=self._boxed, images=self._images)


def _inverted_in_boxes(view: Image, boxes: NDArray[np.float64]) -> Image:
    """A ``view`` (H, W), inverted about its mean inside each of the ``boxes`` (N, 4)."""
    background, size = view.copy(), np.array(view.shape[::-1])
    for box in boxes:
        margin = BOX_MARGIN_SHARE * (box[2:] - box[:2])
        left, top = np.floor(np.clip(box[:2] - margin, 0, size)).astype(int)
        right, bottom = np.ceil(np.clip(box[2:] + margin, 0, size)).astype(int)
        part = np.s_[top:bottom, left:right]
        if view[part].size:
            background[part] = 2 * view[part].mean() - view[part]
    return background
