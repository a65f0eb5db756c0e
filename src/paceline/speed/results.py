"""What a measurement is: estimates per frame, a speed with its interval, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.verdicts import Message

CONFIDENCE = 0.95  # of every interval


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


@dataclass(frozen=True, eq=False)
class RigTold:
    """What one vehicle's pictures tell of the rig, in Q directions in which its calibration may be off, in standard
    uncertainties of it: the ``moves`` (Q,) at which the speeds are, and the ``information`` (Q, Q) that these pictures
    add to what rig.yaml states.

    ``speed`` (Q,) and ``speeds`` (N, Q) are what a further move changes of the mean speed and of the refined ones of
    the track, m/s. If the rig were known these would have the standard uncertainties ``std`` and ``stds`` (N,), and
    the mean one the interval ± ``half``.
    """

    moves: Array
    information: Array
    speed: Array
    std: float
    half: float
    speeds: Array
    stds: Array


@dataclass(frozen=True, eq=False)
class Measurement:
    """The result for one vehicle: the mean speed over the frames measured, its interval, and the verdict.

    ``random_std`` is the vehicle's own standard uncertainty, ``systematic_std`` what the pictures leave open of the
    rig's stated calibration, common to all vehicles that are measured together (NaN where rig.yaml states none). The
    interval is the 95 % interval of both together. Speeds are NaN where nothing could be estimated.
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
    notices: list[str] = field(default_factory=list)
    calibrated_by: int = 0  # vehicles whose pictures have put right what rig.yaml states
    rig: RigTold | None = None  # where that is uncertain, and the vehicle is still to be measured together with others
    reason_code: str = ""  # of `paceline.verdicts`; empty when measured

    def judged(self, reason: Message) -> Measurement:
        """The same with the verdict for a ``reason``: rejected, or measured where that is empty."""
        verdict = "rejected" if reason else "measured"
        return replace(self, verdict=verdict, reason=str(reason), reason_code=reason.code)


@dataclass(frozen=True, eq=False)
class PathDrawing:
    """A reconstructed path as drawn over the pictures."""

    name: str
    points: Array  # (M, 3) world points, metres
    left: Array  # (M, 2) ideal pixels
    right: Array  # (M, 2)


@dataclass(frozen=True, eq=False)
class ClipResult:
    """Everything that `paceline speed` found out about a clip."""

    clip: str
    measurements: list[Measurement]
    paths: list[PathDrawing]
    configuration: dict[str, object]
    versions: dict[str, str]
    notices: list[str]  # dropped, duplicated, skewed frames and the like
    seconds: float = float("nan")  # processing time
