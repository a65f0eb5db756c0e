"""The point of a vehicle whose speed is reported: the middle of the face that was outlined.

On a bend the outer side of a vehicle is faster than its inner one. Where a part of the outline shows what does not move
with the vehicle, such as the road beside it, the middle of the outline is not the middle of the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array, Mask

# The greatest share of its variance that the motion does not explain in a column of patches of the vehicle, in the
# outer column of either side, where rounded shoulders and the outline's own error show a little of what is beside, and
# in the others; and that share relative to the columns' lower quartile, for noise. In 45 outlines of drawn and of
# ray-traced vehicles 99 % of the columns had at most 0.12 (at a side) and 0.09; of those beside the vehicle, in
# outlines moved by 0.3 of their width, 90 % had 0.07 to 0.73.
MAX_OUTER_UNEXPLAINED_SHARE, MAX_INNER_UNEXPLAINED_SHARE, MAX_COLUMN_UNEXPLAINED_RATIO = 0.13, 0.06, 4.0
# What the motion does not explain is not the vehicle where its residual variance is larger than this, relative to the
# columns' lower quartile, or its variance smaller than this, relative to the columns' median: as plain as a road. What
# lies between may be a part of a vehicle of so little contrast that noise hides it.
MIN_RESIDUAL_RATIO, MAX_PLAIN_RATIO = 1.5, 0.1
# Where one side of the outline is beside the vehicle, by a share a of the outline's width, the vehicle reaches beyond
# the other side by 0 (the outline is too wide) to a (it is as wide as the vehicle): the middle is a u off, u from 1/2
# to 1 with a density that grows from 0, as outlines mostly are as wide as the vehicle. Mean and variance of u:
ONE_SIDED_SHIFT, ONE_SIDED_VARIANCE = 5 / 6, 1 / 72


@dataclass(frozen=True, eq=False)
class ReferencePoint:
    """The middle of the vehicle, ``shift`` ± ``std`` widths of the outline to the right of the outline's middle.

    Shares ``beside`` (2,) of the width, at the left and at the right, do not show the vehicle.
    """

    shift: float = 0.0
    std: float = 0.0
    beside: tuple[float, float] = (0.0, 0.0)

    def moved(self, shift: float, corner_std: float) -> ReferencePoint:
        """The same, from the middle of both views' outlines in place of that of the left one: ``shift`` widths to the
        right of it. Their eight corners have a standard deviation of ``corner_std`` widths each."""
        std = float(np.hypot(self.std, corner_std / np.sqrt(8.0)))
        return replace(self, shift=self.shift + shift, std=std)


def reference_point(image_variances: Array, residual_variances: Array) -> ReferencePoint:
    """The middle of the vehicle, from the variance of the images (rows, columns) and the part of it that the motion
    does not explain (rows, columns), in the patches of an outline.

    A column in which any patch moves with the vehicle belongs to it: what is beside a rounded or a dark side of the
    vehicle, in the rest of that column, does not end the vehicle.
    """
    image_variance, residual_variance = image_variances.mean(0), residual_variances.mean(0)
    unexplained = residual_variance / np.maximum(image_variance, 1e-9)
    by_noise = MAX_COLUMN_UNEXPLAINED_RATIO * float(np.quantile(unexplained, 0.25, method="lower"))
    limits = np.full(len(unexplained), MAX_INNER_UNEXPLAINED_SHARE)
    limits[[0, -1]] = MAX_OUTER_UNEXPLAINED_SHARE
    patch_moves = residual_variances <= MAX_INNER_UNEXPLAINED_SHARE * image_variances
    patch_moves &= image_variances >= MAX_PLAIN_RATIO * np.median(image_variances)
    moves = (unexplained <= np.maximum(limits, by_noise)) | patch_moves.any(0)
    is_larger = residual_variance > MIN_RESIDUAL_RATIO * np.quantile(residual_variance, 0.25, method="lower")
    is_plain = image_variance < MAX_PLAIN_RATIO * np.median(image_variance)
    other = ~moves & (is_larger | is_plain)
    columns = len(moves)
    beside = [_columns_beside(moves, other), _columns_beside(moves[::-1], other[::-1])]
    # the edge of the vehicle is anywhere within the next column
    left, right = ((k + 0.5) / columns if k else 0.0 for k in beside)
    edge_variance = columns**-2 / 12
    if left and right:
        return ReferencePoint((left - right) / 2, float(np.sqrt(edge_variance / 2)), (left, right))
    shift = ONE_SIDED_SHIFT * (left - right)
    squared = ((left + right) ** 2 + edge_variance) * (ONE_SIDED_SHIFT**2 + ONE_SIDED_VARIANCE)
    return ReferencePoint(shift, float(np.sqrt(squared - shift**2)) if shift else 0.0, (left, right))


def mean_width(quad: Array) -> float:
    """Mean length (px) of the upper and the lower side of an outline ``quad`` (4, 2)."""
    return float(np.linalg.norm(quad[[1, 2]] - quad[[0, 3]], axis=1).mean())


def _columns_beside(moves: Mask, other: Mask) -> int:
    """How many columns before the first that ``moves`` (columns,) with the vehicle show something ``other`` (columns,),
    or lie before such a column."""
    return int(np.max(np.flatnonzero(other[: np.argmax(moves)]) + 1, initial=0))
