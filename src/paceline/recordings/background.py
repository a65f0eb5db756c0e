"""The background of a recording: the grey level of each pixel of a stationary camera when no vehicle is in view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Image, Mask
from paceline.progress import Progress
from paceline.recordings.stereo import StereoRecording
from paceline.verdicts import NO_REASON, Message, message

MIN_FRAMES = 5  # least frames from which moving objects can be separated from the background
SHORTH_SHARE = 0.4  # share of a pixel's values in the shortest interval: the background is visible at least that often
MAX_BACKGROUND_SIGMA = 3.0  # standard deviations within which a value belongs to the background
MIN_NOISE_GREY = 0.5  # noise of rounding
MAX_NOISE_RATIO = 4.0  # ratio of a pixel's noise to the typical noise, above which it is due to motion
MIN_STABLE_SHARE = 0.5  # least share of the frames that show the background at a stable pixel
MAX_UNSTABLE_SHARE = 0.3  # share of the pixels above which the cameras have moved
ROWS_PER_BLOCK = 64  # rows that are processed at once
NOISE_SAMPLE_STEP_PX = 4  # distance between the pixels from which the typical noise is estimated


@dataclass(frozen=True, eq=False)
class Background:
    """The scene without moving objects: grey (H, W) on a 0–255 scale in ideal pixels, and where it is ``stable``:
    visible in most of the ``frames``."""

    images: tuple[Image, Image]
    stable: tuple[Mask, Mask]
    frames: int

    @property
    def unstable_share(self) -> float:
        """The share of both images in which the background is not stable."""
        return 1.0 - float(np.mean([mask.mean() for mask in self.stable]))


def estimate_background(recording: StereoRecording, max_frames: int, progress: Progress | None = None) -> Background:
    """The background of both views from up to ``max_frames`` frames spread evenly over ``recording``.

    Copies of an earlier frame are left out; there may be fewer than `MIN_FRAMES` frames: see `background_problem`.
    """
    chosen = np.unique(np.linspace(0, len(recording) - 1, min(max_frames, len(recording))).round().astype(int))
    stacks: tuple[list[NDArray[np.float16]], list[NDArray[np.float16]]] = [], []
    for done, frame in enumerate(recording.selected(recording.indices[chosen]), 1):
        if not frame.duplicate:
            stacks[0].append(frame.left.astype(np.float16))
            stacks[1].append(frame.right.astype(np.float16))
        if progress:
            progress(done, len(chosen))
    return background_from(*stacks)


def background_from(left: list[NDArray[np.float16]], right: list[NDArray[np.float16]]) -> Background:
    """The background of as many images (H, W) of either view."""
    backgrounds = [shorth_background(np.stack(stack)) for stack in (left, right)]
    return Background((backgrounds[0][0], backgrounds[1][0]), (backgrounds[0][1], backgrounds[1][1]), len(left))


def background_problem(background: Background) -> Message:
    """Why a background cannot be used; empty where it can."""
    if background.frames < MIN_FRAMES:
        return message("background_too_few_frames", frames=background.frames, min_frames=MIN_FRAMES)
    if (share := background.unstable_share) > MAX_UNSTABLE_SHARE:
        return message("background_unstable", unstable=100 * share, max_unstable=100 * MAX_UNSTABLE_SHARE)
    return NO_REASON


def shorth_background(stack: NDArray[np.float16]) -> tuple[Image, Mask]:
    """The background (H, W) of a ``stack`` (N, H, W), and where most of the frames show it.

    The shortest interval that holds a share `SHORTH_SHARE` of a pixel's values (the shorth has half of them; with fewer
    a road is found that is visible in less than half of the frames) locates the background; the mean of all values near
    it is the result.
    """
    count, height, width = stack.shape
    image, share = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    min_count = min(count, max(2, int(np.ceil(SHORTH_SHARE * count))))
    samples = np.sort(stack[:, ::NOISE_SAMPLE_STEP_PX, ::NOISE_SAMPLE_STEP_PX].astype(np.float32), axis=0)
    typical_std = max(
        float(np.median((samples[min_count - 1 :] - samples[: count - min_count + 1]).min(0))), MIN_NOISE_GREY
    )
    for row in range(0, height, ROWS_PER_BLOCK):
        values = np.sort(stack[:, row : row + ROWS_PER_BLOCK].astype(np.float32), axis=0)
        spread = values[min_count - 1 :] - values[: count - min_count + 1]
        first = np.argmin(spread, axis=0)[None]
        narrowest = np.take_along_axis(spread, first, 0)
        centre = np.take_along_axis(values, first + min_count // 2, 0)
        # a normal distribution holds its densest two fifths within one standard deviation
        sigma = np.clip(narrowest, typical_std, MAX_NOISE_RATIO * typical_std)
        inliers = np.abs(values - centre) <= MAX_BACKGROUND_SIGMA * sigma
        image[row : row + ROWS_PER_BLOCK] = (values * inliers).sum(0) / inliers.sum(0)
        share[row : row + ROWS_PER_BLOCK] = inliers.mean(0)
    return image, share >= MIN_STABLE_SHARE
