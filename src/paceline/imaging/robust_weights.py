"""Weights of robust fits."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array

TUKEY_SIGMA = 4.685  # residual in standard deviations beyond which Tukey's weight is zero


def tukey_weights(residual: Array, sigma: float) -> Array:
    """Tukey's weights (N,) of absolute residuals (N,) whose standard deviation is ``sigma``, of the same unit."""
    return np.asarray(np.maximum(1.0 - (residual / (TUKEY_SIGMA * sigma)) ** 2, 0.0) ** 2)
