"""Whether a camera drifts, or was knocked, beside what it sways: hypotheses about its rotations in time.

The sway of a mast is stationary and, from frame to frame, correlated. Three hypotheses compete for the picture's
displacements: no lasting change, a drift (a line in time), and a knock (a step between two frames).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array

MIN_LASTING_LOG_ODDS = 3.0  # of a lasting change over none
MIN_FRAMES_BESIDE = 3  # on either side of a knock
MIN_LASTING_PX = 0.1  # less moves no feature by more than it is matched to
MIN_SWAY_STD_PX = 0.02  # of displacements that are estimated from corners; see `camera_rotation`


@dataclass(frozen=True)
class LastingTurn:
    """What lasts of a view's displacements: the drift (px/min), and the ``knock`` (px) between the frame ``knocked``
    of those given and the next one; both 0 where there is none."""

    drift_px_per_min: float = 0.0
    knock_px: float = 0.0
    knocked: int = -1


def lasting_turn(time: Array, displacement: Array) -> LastingTurn:
    """The likeliest of the three hypotheses for ``displacement`` (N, 2) px of a picture at ``time`` (N,) s.

    Their evidence is Schwarz's approximation (BIC, 1978), with as many independent frames as the residuals' lag-one
    autocorrelation leaves of N.
    """
    N = len(time)
    if N < 2 * MIN_FRAMES_BESIDE:
        return LastingTurn()
    one, t = np.ones(N), time - time.mean()
    line, still = np.column_stack([one, t]), one[:, None]
    split = _best_split(displacement)
    step = np.column_stack([one, np.arange(N) >= split])
    independent = _independent_frames(_residual(displacement, np.column_stack([line, step[:, 1]])))
    still_evidence = _evidence(displacement, still, independent)
    of_line = _evidence(displacement, line, independent) - still_evidence
    of_step = _evidence(displacement, step, independent) - still_evidence - np.log(N)
    if max(of_line, of_step) < MIN_LASTING_LOG_ODDS:
        return LastingTurn()
    change = float(np.linalg.norm(_fit(displacement, line if of_line > of_step else step)[1]))
    if of_line > of_step:
        return LastingTurn(drift_px_per_min=60.0 * change) if change * np.ptp(t) > MIN_LASTING_PX else LastingTurn()
    return LastingTurn(knock_px=change, knocked=split - 1) if change > MIN_LASTING_PX else LastingTurn()


def _best_split(displacement: Array) -> int:
    """The first frame after the likeliest step, from the sums of squares about the means before and after each."""
    N = len(displacement)
    total, squares = displacement.cumsum(axis=0), (displacement**2).cumsum(axis=0)
    splits = np.arange(MIN_FRAMES_BESIDE, N - MIN_FRAMES_BESIDE + 1)
    before, count = total[splits - 1], splits[:, None]
    about_means = squares[-1] - before**2 / count - (total[-1] - before) ** 2 / (N - count)
    log_std = np.log(np.maximum(about_means, 0.0) / N + MIN_SWAY_STD_PX**2).sum(axis=1)
    return int(splits[np.argmin(log_std)])


def _fit(displacement: Array, X: Array) -> Array:
    return np.asarray(np.linalg.lstsq(X, displacement, rcond=None)[0])


def _residual(displacement: Array, X: Array) -> Array:
    return displacement - X @ _fit(displacement, X)


def _evidence(displacement: Array, X: Array, independent: float) -> float:
    """The logarithm of the evidence for displacements that are linear in ``X`` (N, P), but for a constant."""
    std = np.hypot(_residual(displacement, X).std(axis=0), MIN_SWAY_STD_PX)
    return float(-independent * np.log(std).sum() - X.shape[1] * np.log(independent))


def _independent_frames(residual: Array) -> float:
    """As many of N as the lag-one autocorrelation of a ``residual`` (N, 2) px leaves."""
    correlation = float((residual[1:] * residual[:-1]).sum() / max(float((residual**2).sum()), 1e-12))
    return len(residual) * (1.0 - max(correlation, 0.0)) / (1.0 + max(correlation, 0.0))
