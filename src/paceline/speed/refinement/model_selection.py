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
class RefinedMotion:
    """The refined motion: F frames, n parameters, Q directions in which the rig may shift.

    ``trajectory`` has the rig as it was corrected. ``rig_fit`` is what the images determine of the rig, None where it
    is fixed. ``rig_shift_sigma`` (Q,) are the rig's shifts over the standard deviations that they have if the
    calibration is as uncertain as rig.yaml states.

    Three covariances (n, n) of ``theta`` (n,) add up: ``covariance`` from image noise, ``model_covariance`` from the
    choice among motion models, ``systematic_covariance`` from what remains unknown of the calibration (NaN where the
    rig states no uncertainty).

    ``residual_rms`` is the median RMS residual of a patch and ``contrast`` the RMS of the texture, both grey levels.
    ``offsets`` (F, 2, 2) px are between each view's image and where the motion puts it; ``explained_share`` (F, 2) is
    the share of its weighted variance that the motion explains. Both are NaN where a view was not used.
    """

    trajectory: Trajectory
    rig_shift_sigma: Array
    theta: Array
    covariance: Array
    model_covariance: Array
    systematic_covariance: Array
    rig_fit: RigFit | None
    residual_rms: float
    contrast: float
    offsets: Array
    explained_share: Array
    motion_terms: tuple[str, ...]  # of MOTION_TERMS, chosen by their evidence
    deviation_sigma: (
        float  # rms over the modes of its own way, in standard deviations of what roads and drivers make likely
    )
    dof: float
    converged: bool

    def speeds(self) -> tuple[Array, Array]:
        """Speed (F,) at every frame and its standard deviation (F,), the systematic part, where known, included."""
        g = self.trajectory.speed_shares
        total = self.covariance + self.model_covariance + np.nan_to_num(self.systematic_covariance)
        return g @ self.theta, np.sqrt(np.einsum("fi,ij,fj->f", g, total, g))

    def mean_speed(self) -> tuple[float, float, float, float]:
        """Distance over time, and its standard deviations: random, of the model's choice, and systematic."""
        g = self.trajectory.mean_speed_shares
        random, doubt, systematic = (
            float(np.sqrt(g @ C @ g)) for C in (self.covariance, self.model_covariance, self.systematic_covariance)
        )
        return float(g @ self.theta), random, doubt, systematic


def refine(trajectory: Trajectory, glimpses: list[Glimpse], speed: float, on_path: bool) -> RefinedMotion:
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
    return RefinedMotion(
        fit.trajectory_by(moves),
        fit.rig_shift_sigma,
        theta,
        less * covariance,
        doubt,
        fit.systematic_covariance,
        fit.rig_fit(moves, less * known),
        fit.residual_rms,
        fit.contrast,
        *fit.agreement(),
        extras,
        fit.deviation_sigma,
        fit.dof,
        fit.converged,
    )
