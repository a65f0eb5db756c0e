"""The empty scene behind the traffic: what each pixel shows most of the time a stationary camera looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Image, Mask
from paceline.progress import Progress
from paceline.recordings.stereo import StereoRecording
from paceline.verdicts import NO_REASON, Message, message

FRAMES = 31  # looked at, evenly spread: what the memory holds however long the recording is
FEWEST = 5  # pairs of frames from which what moves can be told from what stands
SHORTEST_SHARE = 0.4  # of a pixel's values that lie closest together: what stands still, shown that often or more
NEAR = 3.0  # standard deviations within which a value belongs to what stands still
LEAST_NOISE = 0.5  # grey levels, of rounding
BUSIEST = 4.0  # times the usual noise: more is no noise but something that moves
SETTLED = 0.5  # share of the frames that must show a pixel's background
MOSTLY_UNSETTLED = 0.3  # share of the pictures without a background from which on the cameras cannot have stood still
STRIP = 64  # rows worked on at once
COARSE = 4  # px between those that tell the usual noise


@dataclass(frozen=True, eq=False)
class Background:
    """The scene without what moves: grey (H, W) on a 0–255 scale in ideal pixels, and where it is ``settled``: shown,
    unhidden, by most of the ``frames``."""

    images: tuple[Image, Image]
    settled: tuple[Mask, Mask]
    frames: int

    @property
    def unsettled_share(self) -> float:
        """Of both pictures, the part in which no background stands out."""
        return 1.0 - float(np.mean([mask.mean() for mask in self.settled]))


def empty_scene(recording: StereoRecording, progress: Progress | None = None) -> Background:
    """The background of both views from up to `FRAMES` frames spread evenly over ``recording``.

    Copies of an earlier frame are left out; there may be fewer than `FEWEST` frames, which is for the caller to judge.
    """
    chosen = np.unique(np.linspace(0, len(recording) - 1, min(FRAMES, len(recording))).round().astype(int))
    stacks: tuple[list[NDArray[np.float16]], list[NDArray[np.float16]]] = [], []
    for done, k in enumerate(chosen, 1):
        at = int(recording.indices[k])
        for frame in recording.frames(at, at + 1):
            if not frame.duplicate:
                stacks[0].append(frame.left.astype(np.float16))
                stacks[1].append(frame.right.astype(np.float16))
        if progress:
            progress(done, len(chosen))
    return background_of(*stacks)


def background_of(left: list[NDArray[np.float16]], right: list[NDArray[np.float16]]) -> Background:
    """The background behind as many pictures (H, W) of either view."""
    found = [steady(np.stack(stack)) for stack in (left, right)]
    return Background((found[0][0], found[1][0]), (found[0][1], found[1][1]), len(left))


def no_background(background: Background) -> Message:
    """Why the recording shows no empty road; empty where it does."""
    if background.frames < FEWEST:
        return message("background_too_few_frames", frames=background.frames, min_frames=FEWEST)
    if (share := background.unsettled_share) > MOSTLY_UNSETTLED:
        return message("background_unstable", unstable=100 * share, max_unstable=100 * MOSTLY_UNSETTLED)
    return NO_REASON


def steady(stack: NDArray[np.float16]) -> tuple[Image, Mask]:
    """What each pixel of a ``stack`` (N, H, W) shows when nothing passes, and where most of the frames show it.

    The values that lie closest together (the shorth, but of `SHORTEST_SHARE` of them, so that a road seen in fewer
    frames than half is still found) say where the background is; the mean of all values near them is the result.
    """
    count, height, width = stack.shape
    image, share = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    least = min(count, max(2, int(np.ceil(SHORTEST_SHARE * count))))
    some = np.sort(stack[:, ::COARSE, ::COARSE].astype(np.float32), axis=0)
    usual = max(float(np.median((some[least - 1 :] - some[: count - least + 1]).min(0))), LEAST_NOISE)
    for row in range(0, height, STRIP):
        values = np.sort(stack[:, row : row + STRIP].astype(np.float32), axis=0)
        spread = values[least - 1 :] - values[: count - least + 1]
        first = np.argmin(spread, axis=0)[None]
        narrowest = np.take_along_axis(spread, first, 0)
        centre = np.take_along_axis(values, first + least // 2, 0)
        # a normal spread holds its densest two fifths within one standard deviation
        sigma = np.clip(narrowest, usual, BUSIEST * usual)
        near = np.abs(values - centre) <= NEAR * sigma
        image[row : row + STRIP] = (values * near).sum(0) / near.sum(0)
        share[row : row + STRIP] = near.mean(0)
    return image, share >= SETTLED
