"""Every knob of the method in one validated place; the defaults are the constants of [Zhu] section V."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Motion = Literal["auto", "free", "line", "curve"]


class SpeedConfiguration(BaseModel):
    """How to measure. The resolved configuration is written beside the results.

    Noises marked "per frame" are those of [Zhu] at its 5 frames/s; for another time step they grow with its square
    root.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    particles: int = Field(400, ge=20, le=1_000_000)
    seed: int = Field(0, ge=0)
    motion: Motion = "auto"  # auto: the path's shape, free without a path
    parts: Literal[4, 6, 8, 10, 12, 16] = 10  # N_p
    refine: bool = True
    resampling: Literal["systematic", "stratified", "residual", "multinomial"] = "systematic"
    tolerance: float | None = Field(None, gt=0, allow_inf_nan=False)  # m/s, half of the widest interval to accept
    exact_path: bool = False  # take the drawn path as an exact rail, as [Zhu] does: biased, for comparison

    guided: bool = True  # move the particles by sub-pixel registration before weighing them; False: as [Zhu]

    lambda_single: float = Field(15.0, gt=0)  # λ_D of (13)
    lambda_cross: float = Field(20.0, gt=0)  # λ_c of (18)
    reference_memory: float = Field(0.3, ge=0, lt=1)  # ε of (14)
    speed_noise: float = Field(0.15, gt=0)  # σ_v, m/s per frame (0.05 for synthetic clips in [Zhu])
    distance_noise: float = Field(0.02, ge=0)  # σ_d, m per frame
    lateral_noise: float = Field(0.10, ge=0)  # σ_P, m per frame, curved paths
    vertical_noise: float = Field(0.03, ge=0)  # σ_B, m per frame, curved paths
    heading_noise: float = Field(0.01, ge=0)  # rad per frame, by which a vehicle turns from its path; none in [Zhu]
    rotation_noise: float = Field(0.01, ge=0)  # σ of each Euler angle's rate, rad/s per frame, free motion
    translation_noise: float = Field(0.15, ge=0)  # σ of each velocity component, m/s per frame, free motion
    speed_guess_spread: float = Field(0.15, gt=0)  # relative spread of the first particles about a given speed
    click_sigma: float = Field(0.5, gt=0)  # px, an operator's hand
    resample_below: float = Field(1.0, gt=0, le=1)  # resample when the effective sample size falls below this share
