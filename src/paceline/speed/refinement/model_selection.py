"""Joint estimation of a vehicle's motion from its whole track, both views, all frames.

Depth, speed, the path's direction and the plane's normal are found so that all pictures agree
(`speed/refinement/photometric_fit.py`), by the model of the motion that the evidence speaks for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.speed.refinement.keyframes import Glimpse
from paceline.speed.refinement.photometric_fit import NEGLIGIBLE, RARE, Fit
from paceline.speed.refinement.self_calibration import RigFit
from paceline.speed.refinement.trajectory import EXTRAS, Trajectory, prior

LEAST_GLIMPSES = 5  # for a choice among models


@dataclass(frozen=True, eq=False)
class Refined:
    """The refined motion: parameters ``theta`` (n,), and what makes them uncertain, as covariances (n, n).

    ``trajectory`` has the rig as it was moved, ``rig_pulls`` (Q,) are these moves in independent directions, each over
    the standard deviation that it has where the calibration is as uncertain as it states, and ``rig_fit`` is what the
    pictures tell of it. ``covariance`` is of the pictures' noise, ``doubt`` of the choice among models, ``systematic``
    of what is left open of the calibration: NaN where the rig states no uncertainty. ``rig_fit`` is None where it may
    not move. ``residual`` is the median rms of a patch in grey levels, ``contrast`` that of the texture; ``offsets``
    (F, 2, 2) are the pixels by which each view's picture lies off the motion and ``explained`` (F, 2) the share of its
    contrast, squared, that the motion explains, as far as places are trusted (NaN where it was not used).
    """

    trajectory: Trajectory
    rig_pulls: Array
    theta: Array
    covariance: Array
    doubt: Array
    systematic: Array
    rig_fit: RigFit | None
    residual: float
    contrast: float
    offsets: Array
    explained: Array
    extras: tuple[str, ...]  # of the motion, that the evidence spoke for, of EXTRAS
    strayed: float  # rms over the modes of its own way, in standard deviations of what roads and drivers make likely
    dof: float
    converged: bool

    def speeds(self) -> tuple[Array, Array]:
        """Speed (F,) at every frame and its standard deviation (F,), the systematic part, where known, included."""
        g = self.trajectory.speed_shares
        total = self.covariance + self.doubt + np.nan_to_num(self.systematic)
        return g @ self.theta, np.sqrt(np.einsum("fi,ij,fj->f", g, total, g))

    def mean_speed(self) -> tuple[float, float, float, float]:
        """Distance over time, and its standard deviations: random, of the model's choice, and systematic."""
        g = self.trajectory.mean_speed_shares
        random, doubt, systematic = (float(np.sqrt(g @ C @ g)) for C in (self.covariance, self.doubt, self.systematic))
        return float(g @ self.theta), random, doubt, systematic


def refine(trajectory: Trajectory, glimpses: list[Glimpse], speed: float, on_path: bool) -> Refined:
    """The motion that all ``glimpses`` agree on.

    ``trajectory`` carries the operator's outline along the path, ``speed`` (m/s) is the filter's mean. Constant speed
    along the path, unless the evidence speaks for a constant acceleration, for swerving — a change of lane — on a path
    for an acceleration that changes, or, without one, for a turn. Raises numpy.linalg.LinAlgError where the images
    determine nothing.
    """
    fit = Fit(trajectory, glimpses, prior(trajectory, speed)).with_rig_free()
    extras: tuple[str, ...] = ()
    possible = {*EXTRAS} - ({"turn"} if on_path else {"surge"})
    others: list[tuple[float, Fit]] = []
    rare = RARE
    while len(glimpses) >= LEAST_GLIMPSES:
        richer = {e: fit.extended(prior(trajectory, speed, (*extras, e)), e) for e in sorted(possible - {*extras})}
        others = list(richer.values())
        convincing = {e for e in richer if richer[e][0] >= rare}
        if "acceleration" in convincing:  # whether it changes is the next question
            convincing -= {"surge"}
        best = max(sorted(convincing), key=lambda e: richer[e][0], default=None)
        if best is None:
            break
        extras, fit = (*extras, best), richer[best][1]
        rare += RARE
    chosen, fit = fit, fit.with_drift()
    moves, theta, variance = fit.over_layouts()
    less = variance / fit.variance
    # a model not chosen may be the true one all the same: as likely as the evidence leaves it
    odds = np.exp([0.0, *(evidence - rare for evidence, _ in others)])
    odds /= odds.sum()
    covariance, known = odds[0] * fit.whole_covariance, odds[0] * fit.covariance_by_rig
    doubt = np.zeros_like(covariance)
    for likely, (_, other) in zip(odds[1:], others, strict=True):
        if likely > NEGLIGIBLE:
            apart = other.theta - chosen.theta
            covariance += likely * other.whole_covariance
            known += likely * other.covariance_by_rig
            doubt += likely * np.outer(apart, apart)
    return Refined(
        fit.trajectory_by(moves),
        fit.pulls,
        theta,
        less * covariance,
        doubt,
        fit.systematic,
        fit.rig_fit(moves, less * known),
        fit.residual,
        fit.contrast,
        *fit.agreement(),
        extras,
        fit.strayed,
        fit.dof,
        fit.converged,
    )
