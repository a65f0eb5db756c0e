"""Every setting of the measurement in one validated place: its range, its default and its effect.

The defaults are the constants of [Zhu] section V where the paper gives them. ``docs/configuration.md`` is made from
the descriptions here.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticKnownError

from paceline.documents.models import KnownKeys, Text, read_document
from paceline.recordings.background import MIN_FRAMES
from paceline.speed.choices import DeviceName, Motion, OverlayChoice, resampling_schemes
from paceline.units import SpeedUnit, parse_unit

MAX_BACKGROUND_S = 3600
PAIR_WORDS = "two numbers above 0"
DIGEST = re.compile(r" \(SHA-256 [0-9a-f]{12}…\)$")  # of a detector, as a summary names it


def _pair(value: Any) -> tuple[float, float]:
    try:
        first, second = (float(v) for v in value)
    except (TypeError, ValueError):
        first = second = 0.0
    if not (0 < first < float("inf") and 0 < second < float("inf")):
        raise ValueError(f"expected {PAIR_WORDS}")
    return first, second


def _overlay_choice(value: Any) -> Any:
    """It was a switch in earlier versions."""
    return {True: "all", False: "none"}[value] if isinstance(value, bool) else value


def _ascending(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] < pair[1]:
        raise ValueError(f"expected {PAIR_WORDS}, the smaller one first")
    return pair


def _none_of(names: Iterable[str]) -> PydanticKnownError:
    *others, last = map(repr, names)
    return PydanticKnownError("literal_error", {"expected": f"{', '.join(others)} or {last}"})


def _registered_scheme(name: str) -> str:
    schemes = resampling_schemes()
    if name not in schemes:
        raise _none_of(schemes)
    return name


def _unit(name: Any) -> SpeedUnit:
    try:
        return parse_unit(str(name))
    except ValueError:
        raise _none_of([unit.value for unit in SpeedUnit]) from None


REGISTERED_SCHEME = AfterValidator(_registered_scheme)
ResamplingScheme = Annotated[str, REGISTERED_SCHEME]
Unit = Annotated[SpeedUnit, BeforeValidator(_unit)]
Pair = Annotated[tuple[float, float], BeforeValidator(_pair)]
ASCENDING = AfterValidator(_ascending)
Range = Annotated[Pair, ASCENDING]


class Section(KnownKeys):
    model_config = ConfigDict(frozen=True)


class StartSettings(Section):
    """The first two frames, in which the speed is not known yet."""

    speed_range: Range = Field((0.5, 75.0), description="speeds searched without a first guess, m/s")
    particle_factor: int = Field(8, ge=1, le=100, description="how many times as many particles that search takes")


class TrackingSettings(Section):
    """The filter from the third frame on."""

    max_occluded_frames: int = Field(
        4, ge=1, le=10_000, description="frames in a row that may hide the vehicle before it is given up as lost"
    )


class DriverSettings(Section):
    """How vehicles are driven: standard deviations of the motion that the fit of the whole track expects."""

    steadiness: float = Field(
        0.15, gt=0, le=10, description="acceleration of a driver who holds the speed, m/s²; less: straighter speeds"
    )
    braking: float = Field(2.0, gt=0, le=30, description="acceleration of one who brakes or speeds up, m/s²")
    braking_time: float = Field(0.4, ge=0.05, le=60, description="correlation time of an acceleration that varies, s")
    heading: float = Field(
        float(np.radians(1.0)),
        gt=0,
        le=0.2,
        description="direction of travel from that of the path, sideways, rad; more: the path determines less",
    )
    pitch: float = Field(float(np.radians(0.3)), gt=0, le=0.2, description="the same up and down, rad")
    lane_change: float = Field(0.1, gt=0, le=0.5, description="direction of travel in a lane change, sideways, rad")
    lane_change_length: float = Field(8.0, ge=1, le=1000, description="correlation length of that direction, m")


class ModelSettings(Section):
    """The choice of the motion model: constant speed along the path, and the further terms that the images ask for."""

    min_log_odds: float = Field(
        3.0, ge=0, description="log odds required of an acceleration, a lane change or a turn; 3: 20 to 1"
    )


class RefinementSettings(Section):
    """The fit of the whole track at the end."""

    max_keyframes: int = Field(
        32, ge=8, le=1000, description="frames that are fitted, evenly spread over the track; more: slower, more exact"
    )


class Limits(Section):
    """Beyond these a vehicle is rejected."""

    min_frames: int = Field(4, ge=4, le=1000, description="frames in which a vehicle has to be tracked")
    max_speed: float = Field(90.0, gt=0, le=1000, description="speed that is plausible, m/s")
    max_half_width: float = Field(0.06, gt=0, description="half-width of the 95 % interval, as a share of the speed …")
    max_half_width_mps: float = Field(
        SpeedUnit.KMH.mps, ge=0, description="… or in m/s, where that is more: the interval of a slow vehicle"
    )
    max_random_share: float = Field(
        2 / 3, gt=0, le=1, description="share of the permitted half-width that the random part may take"
    )
    image_offset_px: float = Field(
        0.6, gt=0, description="rms offset of the images from the fitted motion, and of one frame that counts, pixels"
    )
    unexplained_contrast: float = Field(
        0.6, gt=0, le=1, description="share of the texture's contrast that the fitted motion may leave unexplained"
    )
    consistent_share: float = Field(
        0.5, ge=0, le=1, description="share of the frames that have to show the vehicle where the fitted motion puts it"
    )
    epipolar_offset_px: float = Field(
        1.0, gt=0, description="distance between the two views across the epipolar lines, pixels"
    )
    rig_shift_sigma: float = Field(
        5.0, gt=0, description="standard deviations by which image evidence may shift the calibration in rig.yaml"
    )
    outline_sigma: float = Field(
        5.0, gt=0, description="standard deviations of the right outline's place by which the motion may miss it"
    )


class JointCalibrationSettings(Section):
    """Vehicles that pass one rig and calibrate it together."""

    neighbours: int = Field(8, ge=0, le=1000, description="other vehicles that one is calibrated with; 0: none")
    window_s: float = Field(600.0, gt=0, description="seconds before and after a vehicle within which they pass")


class BackgroundSettings(Section):
    """The road without vehicles, in which lanes and vehicles are detected."""

    seconds: float = Field(
        30.0, ge=0, le=MAX_BACKGROUND_S, description="seconds of which it is made with `--live`; else of the recording"
    )
    frames: int = Field(
        31, ge=MIN_FRAMES, le=1000, description="frames of which it is made, evenly spread; more: cleaner, more memory"
    )


class LaneSettings(Section):
    """Lanes between painted lines."""

    width: Range = Field((2.2, 5.5), description="least and greatest width of a lane between its lines, m")


class DetectionSettings(Section):
    """Vehicles that nobody has outlined."""

    near: float = Field(5.0, gt=0, description="distance from the left camera from which vehicles are searched, m")
    far: float = Field(150.0, gt=0, description="distance up to which they are, m; less: faster")
    min_size_px: Pair = Field(
        (16.0, 6.0), description="least width and height of an outline, pixels; less: from farther away, less exactly"
    )
    max_height: float = Field(
        4.5, ge=2.5, le=20, description="height of the tallest vehicles, m; behind them nothing is searched up to it"
    )
    score: float = Field(0.25, ge=0, le=1, description="least score of a detector's box")

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        if not self.near < self.far:
            raise ValueError("expected near below far")
        return self


class LiveSettings(Section):
    """Measuring while the cameras record."""

    buffer_pairs: int = Field(
        150, ge=2, le=100_000, description="pairs of frames kept in memory for the vehicles in view"
    )
    queue: int = Field(8, ge=1, le=10_000, description="vehicles that may wait to be measured")
    pairs_per_vehicle: int = Field(24, ge=4, le=10_000, description="pairs of frames that a vehicle is measured on")
    kept_pictures: int = Field(200, ge=1, le=1_000_000, description="pictures of vehicles kept, the latest ones")


class ReportSettings(Section):
    """What people are shown. Tables and summary.json are in SI units."""

    units: Unit = Field(SpeedUnit.MPH, description="unit of the speeds in terminal, report and overlay")
    overlay: Annotated[OverlayChoice, BeforeValidator(_overlay_choice)] = Field(
        "auto",
        description="frames in the overlay video: all, those with a `rejected` vehicle, or none; `auto`: all of a "
        "recording of up to a minute, none of a longer one",
    )


class SpeedConfiguration(Section):
    """How to measure. The resolved configuration is written beside the results.

    Noises marked "per frame" are those of [Zhu] at its 5 frames/s; for another time step they grow with its square
    root.
    """

    particles: int = Field(
        400, ge=20, le=1_000_000, description="particles of the filter; more: smoother estimates per frame, slower"
    )
    seed: int = Field(0, ge=0, description="of the random numbers; the same seed gives the same result")
    motion: Motion = Field("auto", description="`auto` follows the path's shape, `free` ignores paths")
    parts: Literal[4, 6, 8, 10, 12, 16] = Field(10, description="parts N_p of the likelihood")
    refine: bool = Field(True, description="fit the whole track at the end; off: the filter's mean speed, biased")
    resampling: ResamplingScheme = Field(
        "systematic", description="scheme by which particles are resampled; on a GPU only `systematic`"
    )
    tolerance: float | None = Field(
        None, gt=0, description="reject every speed whose 95 % interval is wider than ± this, m/s"
    )
    exact_path: bool = Field(
        False, description="take the drawn path as a hard constraint, as [Zhu] does: biased, for comparison"
    )
    guided: bool = Field(
        True,
        description="move the particles by sub-pixel registration before weighting, and without a path by coordinated "
        "turns; off: as [Zhu]",
    )
    lambda_single: float = Field(15.0, gt=0, description="λ_D of (13): weight of each view's likelihood")
    lambda_cross: float = Field(20.0, gt=0, description="λ_c of (18): weight of the likelihood across the views")
    reference_memory: float = Field(0.3, ge=0, lt=1, description="ε of (14): share of the old reference that is kept")
    speed_noise: float = Field(0.15, gt=0, description="σ_v, m/s per frame (0.05 for synthetic clips in [Zhu])")
    distance_noise: float = Field(0.02, ge=0, description="σ_d, m per frame")
    lateral_noise: float = Field(0.10, ge=0, description="σ_P, m per frame, on curved paths")
    vertical_noise: float = Field(0.03, ge=0, description="σ_B, m per frame, on curved paths")
    heading_noise: float = Field(
        0.01, ge=0, description="rad per frame by which a vehicle turns from its path; none in [Zhu]"
    )
    rotation_noise: float = Field(
        0.01, ge=0, description="σ of each Euler angle's rate, rad/s per frame, in free motion"
    )
    translation_noise: float = Field(
        0.15, ge=0, description="σ of each velocity component, m/s per frame, in free motion"
    )
    speed_guess_spread: float = Field(
        0.15, gt=0, description="relative standard deviation of a speed that is given as a first guess"
    )
    click_sigma: float = Field(0.5, gt=0, description="standard deviation of a drawn corner, pixels")
    line_sigma: float = Field(
        0.5, gt=0, description="standard deviation of a drawn point of a road line, pixels, where few points tell"
    )
    resample_below: float = Field(
        1.0, gt=0, le=1, description="resample when the effective sample size falls below this share of the particles"
    )
    start: StartSettings = StartSettings()
    tracking: TrackingSettings = TrackingSettings()
    driver: DriverSettings = DriverSettings()
    model: ModelSettings = ModelSettings()
    refinement: RefinementSettings = RefinementSettings()
    limits: Limits = Limits()
    joint_calibration: JointCalibrationSettings = JointCalibrationSettings()
    background: BackgroundSettings = BackgroundSettings()
    lanes: LaneSettings = LaneSettings()
    detection: DetectionSettings = DetectionSettings()
    live: LiveSettings = LiveSettings()
    report: ReportSettings = ReportSettings()


DEFAULTS = SpeedConfiguration()
DEFAULT_LIMITS = DEFAULTS.limits


class SpeedSettings(SpeedConfiguration):
    """What a configuration file may hold: the configuration, and by which method, where and on what to measure. A
    summary's own ``configuration`` is such a file."""

    method: Text = Field("paceline", description="how to measure: Paceline's method, or one that it is compared with")
    device: DeviceName = Field("cpu", description="where to compute; `auto`: a GPU where one can be used")
    detector: Text | None = Field(
        None, description="an ONNX detector in whose boxes vehicles are detected, relative to the configuration file"
    )
    learn: float | None = Field(None, ge=0, le=MAX_BACKGROUND_S, description="earlier name of `background.seconds`")

    @model_validator(mode="before")
    @classmethod
    def _apply_learn(cls, value: Any) -> Any:
        if not isinstance(value, dict) or (learn := value.get("learn")) is None:
            return value
        background = value.get("background", {})
        if not isinstance(background, dict):
            return value
        if background.get("seconds", learn) != learn:
            raise ValueError("learn and background.seconds: one key under two names; expected one of them")
        return {**value, "background": {**background, "seconds": learn}}

    @property
    def configuration(self) -> SpeedConfiguration:
        fields = {name: getattr(self, name) for name in SpeedConfiguration.model_fields}
        return SpeedConfiguration.model_construct(**fields)

    @property
    def detector_file(self) -> Path | None:
        """The detector's file; a summary adds to its name how its digest begins."""
        return None if self.detector is None else Path(DIGEST.sub("", self.detector))


def load_settings(path: str | Path) -> SpeedSettings:
    """The settings in a YAML file; raises UnusableInput, naming the key, where they cannot be used."""
    return read_document(SpeedSettings, Path(path))
