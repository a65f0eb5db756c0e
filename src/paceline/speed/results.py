"""Results of a measurement: estimates per frame, the mean speed with its interval, the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.errors import UnusableInput
from paceline.verdicts import Message

CONFIDENCE_LEVEL = 0.95  # confidence level of all intervals


MIN_TRAVEL_M = 1.0  # of a vehicle whose direction is told

SUMMARY_COLUMNS = (
    "vehicle", "speed_mps", "speed_lo_mps", "speed_hi_mps", "frames", "verdict", "reason", "reason_code",
    "random_std_mps", "systematic_std_mps", "calibrated_by", "model", "acceleration_mps2", "residual_rms",
    "outline_offset_px", "corners_difference_mps", "corners_difference_std_mps", "interval_from", "path", "direction",
    "travel", "seen_from_s", "seen_to_s", "limit_mps", "compliance",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Track:
    """One vehicle's estimates, one entry per frame in aligned arrays (SI units; N frames, P particles)."""

    vehicle: str
    frame: NDArray[np.int64]  # (N,)
    time: Array  # (N,) s
    speed: Array  # (N,) m/s, the filter's posterior mean
    speed_std: Array  # (N,) m/s, the filter's posterior spread
    position: Array  # (N, 3) m, centre of the tracked plane in the world frame
    yaw_rate: Array  # (N,) rad/s, NaN at the first frame
    left: Array  # (N, 4, 2) ideal pixels, corners tl, tr, br, bl
    right: Array  # (N, 4, 2)
    ess: Array  # (N,) effective sample size
    status: list[str]  # tracking | lost | ended
    particles_left: Array  # (N, P, 2) projected plane centres of the particles
    particles_right: Array  # (N, P, 2)
    refined_speed: Array  # (N,) m/s, NaN without refinement
    refined_std: Array  # (N,) m/s, systematic part included where known; NaN without refinement
    hidden: NDArray[np.bool_]  # (N,) tracked by its motion alone: the images do not show the vehicle, and do not count

    @property
    def appearance(self) -> list[str]:
        """How each frame shows the vehicle: its status, or ``hidden`` where it is tracked by its motion alone."""
        pairs = zip(self.status, self.hidden.tolist(), strict=True)
        return ["hidden" if hidden else status for status, hidden in pairs]

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Which frames (N,) count in the measurement."""
        return self.tracked & ~self.hidden

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """Which frames (N,) the vehicle was tracked in."""
        return np.array([status == "tracking" for status in self.status], bool)

    @property
    def tracked_positions(self) -> Array:
        """Where the vehicle was tracked, (M, 3) m, without positions that are not known."""
        positions = self.position[self.tracked].reshape(-1, 3)
        return positions[np.isfinite(positions).all(axis=1)]


@dataclass(frozen=True)
class Synchronisation:
    """Both cameras may be triggered together, as likely as not: then the cameras' offset is ``value`` in its
    ``direction``; else it has the prior ``density`` there."""

    direction: int
    value: float
    density: float


@dataclass(frozen=True, eq=False)
class RigInformation:
    """What one vehicle's images determine of the cameras, in Q directions, in standard uncertainties beforehand.

    The last of these directions are those of the exposures, with the standard uncertainties ``exposure_stds`` (s) by
    name. ``offset`` (Q,) is the cameras' offset to which the speeds belong, ``information`` (Q, Q) what the images add
    to the prior. ``mean_speed_gradient`` (Q,) and ``speed_jacobian`` (N, Q) are the derivatives of the mean speed and
    of the track's refined speeds by a further offset, m/s. With the cameras known, these speeds have the standard
    uncertainties ``mean_speed_std`` and ``speed_stds`` (N,), and the mean speed the interval ± ``half_width``, m/s.
    """

    offset: Array
    information: Array
    mean_speed_gradient: Array
    mean_speed_std: float
    half_width: float
    speed_jacobian: Array
    speed_stds: Array
    exposure_stds: dict[str, float] = field(default_factory=dict)
    synchronisation: Synchronisation | None = None  # None where the offset between the views is stated


@dataclass(frozen=True, eq=False)
class Measurement:
    """The result for one vehicle: its mean speed over the frames measured (m/s), the interval and the verdict.

    ``random_std`` is the vehicle's own standard uncertainty. ``systematic_std`` comes from the calibration, as far as
    images did not correct it, and is common to all vehicles that are calibrated jointly (NaN where it is
    exact, and where its effect is not computed). The 95 % interval holds both. Speeds are NaN where nothing could be
    estimated.
    """

    vehicle: str
    track: Track
    speed: float
    speed_lo: float
    speed_hi: float
    random_std: float
    systematic_std: float
    frames: int
    verdict: str  # measured | rejected
    reason: str  # empty when measured
    model: str  # e.g. "constant speed", "constant acceleration", "filter" without refinement
    acceleration: float = float("nan")  # m/s², NaN for a constant-speed model
    residual_rms: float = float("nan")  # grey levels of 255, of the refined fit
    outline_offset: float = float("nan")  # px, RMS over frames and views from where the motion puts the outlined part
    # m/s, how far from the refined speed that by tracked corners is, and its standard deviation; NaN without such
    corners_difference: float = float("nan")
    corners_difference_std: float = float("nan")
    notices: list[str] = field(default_factory=list)
    calibrated_by: int = 0  # vehicles whose images have corrected the calibration of rig.yaml
    rig_information: RigInformation | None = None  # for joint calibration, None where that is done or impossible
    reason_code: str = ""  # of `paceline.verdicts`; empty when measured
    path: str | None = None  # the name of its path
    direction: str | None = None  # with | against the order in which the path was drawn
    limit: float | None = None  # m/s, the posted limit

    @property
    def interval_from(self) -> str | None:
        """What the interval comes from: ``fit``, that of the whole track with random and systematic part, ``filter``,
        the filter's own spread, or ``scatter``, that of a baseline's values; None without an interval."""
        if not np.isfinite([self.speed_lo, self.speed_hi]).all():
            return None
        codes = {notice.code for notice in self.notices if isinstance(notice, Message)}
        return "scatter" if "baseline_interval" in codes else "filter" if "not_refined" in codes else "fit"

    @property
    def seen(self) -> tuple[float, float] | None:
        """When it was first and last tracked, s; None where it was not."""
        times = self.track.time[self.track.tracked]
        return (float(times[0]), float(times[-1])) if len(times) else None

    @property
    def travel(self) -> str | None:
        """How the cameras see it drive: ``approaching``, ``receding``, ``to the left`` or ``to the right``; None where
        it hardly moves."""
        positions = self.track.tracked_positions
        if len(positions) < 2:
            return None
        x, _, z = positions[-1] - positions[0]
        if max(abs(x), abs(z)) < MIN_TRAVEL_M:
            return None
        if abs(z) >= abs(x):
            return "approaching" if z < 0 else "receding"
        return "to the left" if x < 0 else "to the right"

    @property
    def compliance(self) -> str | None:
        """Whether the limit is kept, by the 95 % interval: ``within``, ``over`` or ``undecided``; None without a limit
        or a measured speed."""
        if self.limit is None or self.verdict != "measured":
            return None
        return "within" if self.speed_hi <= self.limit else "over" if self.speed_lo > self.limit else "undecided"

    def summary(self) -> dict[str, object]:
        """The vehicle's entry of summary.json."""
        return {
            "vehicle": self.vehicle,
            "speed_mps": self.speed,
            "speed_lo_mps": self.speed_lo,
            "speed_hi_mps": self.speed_hi,
            "frames": self.frames,
            "verdict": self.verdict,
            "reason": self.reason,
            "reason_code": self.reason_code,
            "random_std_mps": self.random_std,
            "systematic_std_mps": self.systematic_std,
            "calibrated_by": self.calibrated_by,
            "model": self.model,
            "acceleration_mps2": self.acceleration,
            "residual_rms": self.residual_rms,
            "outline_offset_px": self.outline_offset,
            "corners_difference_mps": self.corners_difference,
            "corners_difference_std_mps": self.corners_difference_std,
            "interval_from": self.interval_from,
            "path": self.path,
            "direction": self.direction,
            "travel": self.travel,
            "seen_from_s": None if self.seen is None else self.seen[0],
            "seen_to_s": None if self.seen is None else self.seen[1],
            "limit_mps": self.limit,
            "compliance": self.compliance,
            "notices": self.notices,
        }

    def with_verdict(self, reason: Message) -> Measurement:
        """This measurement with the verdict for a ``reason``: rejected, or measured where that is empty."""
        verdict = "rejected" if reason else "measured"
        return replace(self, verdict=verdict, reason=str(reason), reason_code=reason.code)


@dataclass(frozen=True, eq=False)
class PathDrawing:
    """A reconstructed path, projected into both views."""

    name: str
    points: Array  # (M, 3) world points, metres
    left: Array  # (M, 2) ideal pixels
    right: Array  # (M, 2)


@dataclass(frozen=True)
class ExposureEstimate:
    """By how much a quantity of the exposures differs from what was known beforehand (``difference``, s, with its
    standard deviation ``std``), and the relative change of the median vehicle's speed by that (``speed_effect``)."""

    difference: float
    std: float
    speed_effect: float


@dataclass(frozen=True, eq=False)
class ClipResult:
    """The results of `paceline speed` for one clip."""

    clip: str
    measurements: list[Measurement]
    paths: list[PathDrawing]
    configuration: dict[str, object]
    versions: dict[str, str]
    notices: list[str]  # dropped, duplicated, skewed frames and the like
    seconds: float = float("nan")  # processing time
    exposures: dict[str, ExposureEstimate] = field(default_factory=dict)  # by name, what vehicles determine of them
    cameras: dict[str, object] = field(default_factory=dict)  # what is not taken as ideal, as in summary.json
    lag: float = 0.0  # s, by which the right one of two videos was found to lag when it was paired with the left one

    def to_pandas(self) -> Any:
        """A pandas.DataFrame with a row per vehicle: the keys of summary.json but for the notices. Raises UnusableInput
        where pandas is not installed."""
        return _import("pandas", "to_pandas").DataFrame(self._columns())

    def to_arrow(self) -> Any:
        """As `to_pandas`, a pyarrow.Table."""
        return _import("pyarrow", "to_arrow").table(self._columns())

    def _columns(self) -> dict[str, list[object]]:
        rows = [m.summary() for m in self.measurements]
        return {key: [row[key] for row in rows] for key in SUMMARY_COLUMNS}


def _import(package: str, purpose: str) -> Any:
    """A package that Paceline does not depend on."""
    try:
        return import_module(package)
    except ImportError as error:
        raise UnusableInput(f"{purpose} needs {package} ({error}); install it with: pip install {package}") from None
