"""Weights of robust fits."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array

TUKEY_SIGMA = 4.685  # residual in standard deviations beyond which Tukey's weight is zero


def robust_sigma(residual: Array, least: float) -> float:
    """Standard deviation of normal errors by the median of their absolute values (N,), at least ``least``."""
    return max(1.4826 * float(np.median(residual)), least)


def tukey_weights(residual: Array, sigma: float) -> Array:
    """Tukey's weights (N,) of absolute residuals (N,) whose standard deviation is ``sigma``, of the same unit."""
    return np.asarray(np.maximum(1.0 - (residual / (TUKEY_SIGMA * sigma)) ** 2, 0.0) ** 2)
