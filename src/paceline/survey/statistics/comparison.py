"""A site before and after: weights of matched flows, and the difference of two estimates."""

from __future__ import annotations

import math

import numpy as np

from paceline.arrays import Array, Indices
from paceline.survey.statistics.common_error import combination
from paceline.survey.statistics.estimate import Estimate
from paceline.survey.statistics.interval import Interval, t_factor


def matching_weights(before_cell: Indices, after_cell: Indices) -> tuple[Array, Array]:
    """Weights (N,) of the passages before and (M,) after, each of mean 1, that give both the flows before.

    ``before_cell`` (N,) and ``after_cell`` (M,) are numbers of cells, as lane × weekday or weekend × clock hour.
    Passages in cells that only one side has get 0, all of them where no cell is common.
    """
    cells = np.union1d(before_cell, after_cell)
    member = [np.searchsorted(cells, cell) for cell in (before_cell, after_cell)]
    before, after = (np.bincount(m, minlength=len(cells)) for m in member)
    is_common = (before > 0) & (after > 0)
    ratio = np.divide(before, after, out=np.zeros(len(cells)), where=after > 0)
    return _of_mean_1(is_common.astype(float)[member[0]]), _of_mean_1(ratio[member[1]])


def _of_mean_1(weights: Array) -> Array:
    return weights / weights.mean() if weights.any() else weights


def difference(a: Estimate, b: Estimate) -> Estimate:
    """``b`` − ``a``, in their unit: of after and before, or of two differences, a site's and its control's.

    Random parts by MOVER (Zou & Donner 2008): lo = D − √((b − b_lo)² + (a_hi − a)²), hi likewise, each side's
    half-widths scaled from its own Student's t to that of the pooled degrees of freedom (Welch 1947, Satterthwaite
    1946). Common errors of the same block enter as h_b − h_a, so that those of one calibration nearly cancel;
    different ones add. Shifts are subtracted.
    """
    variances = [((e.random.hi - e.random.lo) / (2 * t_factor(e.random.dof))) ** 2 for e in (a, b)]
    dof = _pooled_dof(variances, [a.random.dof, b.random.dof])
    scale_a, scale_b = (t_factor(dof) / t_factor(e.random.dof) for e in (a, b))
    value = b.random.value - a.random.value
    below = math.hypot(scale_b * (b.random.value - b.random.lo), scale_a * (a.random.hi - a.random.value))
    above = math.hypot(scale_b * (b.random.hi - b.random.value), scale_a * (a.random.value - a.random.lo))
    random = Interval(value, value - below, value + above, dof)
    return Estimate(random, b.shift - a.shift, combination([(1.0, b.common), (-1.0, a.common)]))


def _pooled_dof(variances: list[float], dofs: list[float]) -> float:
    """Degrees of freedom of the sum of two ``variances``; infinite where it is 0 or not known."""
    total = sum(s**2 / dof for s, dof in zip(variances, dofs, strict=True))
    return sum(variances) ** 2 / total if total > 0 else math.inf
