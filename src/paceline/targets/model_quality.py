"""How good a learned model is: its contrast, what one image tells by it, and whether it looks like a vehicle's rear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Image
from paceline.number_format import format_half_width
from paceline.targets.image_lines import Line
from paceline.targets.side_estimation import EDGE_SIDE_STD_PX
from paceline.units import COVERAGE_95
from paceline.verdicts import Message, message

CONTRAST_REACH_PX = 2.0  # distance from a line at which the grey levels beside it are compared
# A line is mirrored where another one, or itself if it crosses the middle, ends there: as a share of the width
MIRROR_TOLERANCE, MIRROR_TOLERANCE_PX = 0.06, 2.5
# Where a model is doubted. 98 models of drawn, ray-traced and real vehicles had 0.63 or more of their lines mirrored
# and 16 grey levels of contrast; of 118 boxes on houses, trees and the road more than 110 had less than 0.6 mirrored.
MIN_MIRRORED_SHARE = 0.6
MIN_CONTRAST = 8.0  # grey levels
MAX_SCALE_ERROR = 0.02  # 95 %, of one image


@dataclass(frozen=True)
class ModelQuality:
    """What a model's lines are worth: ``contrast`` is the median difference of the grey levels on both sides of a line;
    the standard deviations are those of the centre, px, and of the scale, relative, as one image tells them by lines
    that are each located to EDGE_SIDE_STD_PX; ``mirrored_share`` is the share of the lines, by length, that are
    mirrored about the middle, as those of a vehicle's rear are."""

    horizontal: int
    vertical: int
    contrast: float
    across_std: float
    down_std: float
    scale_std: float
    mirrored_share: float

    def __str__(self) -> str:
        place_px = format_half_width(COVERAGE_95 * max(self.across_std, self.down_std))
        distance_percent = format_half_width(100 * COVERAGE_95 * self.scale_std)
        return (
            f"{self.horizontal} horizontal and {self.vertical} vertical lines, {100 * self.mirrored_share:.0f} % of "
            f"them mirrored about the middle, with {self.contrast:.0f} grey levels of contrast; one image determines "
            f"its place to ± {place_px} px and its distance to ± {distance_percent} % (95 %)"
        )

    def doubts(self) -> tuple[Message, ...]:
        """Warnings where the model is poor."""
        found = []
        if self.mirrored_share < MIN_MIRRORED_SHARE:
            found.append(
                message("target_not_symmetric", percent=100 * self.mirrored_share, limit=100 * MIN_MIRRORED_SHARE)
            )
        if self.contrast < MIN_CONTRAST:
            found.append(message("target_faint", contrast=self.contrast, limit=MIN_CONTRAST))
        if (error := COVERAGE_95 * self.scale_std) > MAX_SCALE_ERROR:
            found.append(message("target_scale_uncertain", percent=100 * error, limit=100 * MAX_SCALE_ERROR))
        return tuple(found)


def judge_model(image: Image, horizontal: Sequence[Line], vertical: Sequence[Line], middle: Array) -> ModelQuality:
    """The quality of a model of these lines, found in ``image`` (H, W), 0–255, its centre at ``middle`` (2,) px."""
    upright, level = np.asarray(image, float), np.asarray(image, float).T
    contrasts = [line_contrast(upright, line) for line in vertical] + [
        line_contrast(level, line) for line in horizontal
    ]
    u = np.array([line.place for line in vertical]) - middle[0]
    v = np.array([line.place for line in horizontal]) - middle[1]
    rows = np.vstack([np.column_stack([np.ones_like(u), np.zeros_like(u), u]),
                      np.column_stack([np.zeros_like(v), np.ones_like(v), v])])  # fmt: skip
    across_std, down_std, scale_std = EDGE_SIDE_STD_PX * np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))
    return ModelQuality(
        horizontal=len(horizontal),
        vertical=len(vertical),
        contrast=float(np.median(contrasts)),
        across_std=float(across_std),
        down_std=float(down_std),
        scale_std=float(scale_std),
        mirrored_share=mirrored_share(horizontal, vertical, float(middle[0])),
    )


def line_contrast(image: Image, line: Line) -> float:
    """The mean difference of the grey levels of ``image`` (H, W) right and left of a vertical ``line``."""
    first, last = round(line.start + 0.5), round(line.stop - 0.5)
    columns = np.clip(np.rint(line.place + np.array([-CONTRAST_REACH_PX, CONTRAST_REACH_PX])), 0, image.shape[1] - 1)
    left, right = image[first : last + 1, columns.astype(int)].mean(axis=0)
    return float(abs(right - left))


def mirrored_share(horizontal: Sequence[Line], vertical: Sequence[Line], middle: float) -> float:
    """The share of the lines, by length, that have their mirror image about x = ``middle`` px among them."""
    xs = [x for line in horizontal for x in (line.start, line.stop)] + [line.place for line in vertical]
    tolerance = max(MIRROR_TOLERANCE_PX, MIRROR_TOLERANCE * (max(xs) - min(xs)))
    mirrored = [
        line
        for line in vertical
        if any(abs(line.place + o.place - 2 * middle) <= tolerance and _overlap(line, o) for o in vertical)
    ]
    mirrored += [
        line
        for line in horizontal
        if any(
            max(abs(line.start + o.stop - 2 * middle), abs(line.stop + o.start - 2 * middle)) <= 2 * tolerance
            and abs(line.place - o.place) <= tolerance
            for o in horizontal
        )
    ]
    return sum(line.length for line in mirrored) / sum(line.length for line in [*horizontal, *vertical])


def _overlap(line: Line, other: Line) -> bool:
    """Whether two parallel lines run beside each other for half of the shorter one."""
    shared = min(line.stop, other.stop) - max(line.start, other.start)
    return shared >= 0.5 * min(line.length, other.length)
