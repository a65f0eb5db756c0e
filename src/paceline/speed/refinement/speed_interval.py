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
        random_half_width = float(np.hypot(noise_quantile(refined.dof) * noise_std, COVERAGE_95 * model_std))
        half_width = float(np.hypot(random_half_width, COVERAGE_95 * np.nan_to_num(systematic_std)))
        return SpeedInterval(
            speed, float(np.hypot(noise_std, model_std)), systematic_std, half_width, random_half_width
        )


def noise_quantile(dof: float) -> float:
    """The half-width of the noise's interval in standard deviations, which few frames and patches determine: that of
    Student's distribution of ``dof`` degrees of freedom."""
    return float(stdtrit(dof, 0.5 + CONFIDENCE_LEVEL / 2))
