"""The confidence interval of a refined mean speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from paceline.speed.refinement.model_selection import RefinedMotion
from paceline.speed.results import CONFIDENCE_LEVEL
from paceline.units import COVERAGE_95


@dataclass(frozen=True)
class SpeedInterval:
    """A mean ``speed`` (m/s), its random and its systematic standard deviation (NaN where the calibration is exact) and
    the half-widths of its interval, as a whole and without the systematic part."""

    speed: float
    random_std: float
    systematic_std: float
    half_width: float
    random_half_width: float

    @staticmethod
    def of(refined: RefinedMotion) -> SpeedInterval:
        speed, noise_std, model_std, systematic_std = refined.mean_speed()
        random = random_half_width(noise_std, model_std, refined.noise_dof(refined.covariance))
        half_width = float(np.hypot(random, COVERAGE_95 * np.nan_to_num(systematic_std)))
        return SpeedInterval(speed, float(np.hypot(noise_std, model_std)), systematic_std, half_width, random)


def random_half_width(noise_std: float, model_std: float, dof: float) -> float:
    """The half-width of an interval by noise and by the choice of a model, of these standard deviations.

    Few frames and patches determine the noise: its part is that of Student's distribution with ``dof`` effective
    degrees of freedom.
    """
    noise_quantile = stdtrit(dof, 0.5 + CONFIDENCE_LEVEL / 2)
    return float(np.hypot(noise_quantile * noise_std, COVERAGE_95 * model_std))
