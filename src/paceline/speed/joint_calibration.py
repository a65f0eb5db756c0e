"""One rig, many vehicles: what all their pictures together tell of the calibration puts each of their speeds right.

Each vehicle's fit is a Gaussian in its own motion and in the rig's moves (`speed/refinement/self_calibration.py`). The
rig is the same for all of them, so that what their pictures tell of it adds up, and each motion follows where all of
them move the rig. But a rig is not the same for ever, as it warms up by day: each vehicle is put right by those that
passed about when it did.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from paceline.arrays import Array
from paceline.speed import verdict
from paceline.speed.configuration import DEFAULTS, JointCalibrationSettings, SpeedConfiguration
from paceline.speed.refinement.photometric_fit import UNTOLD
from paceline.speed.results import CONFIDENCE, Measurement, RigTold, Track
from paceline.verdicts import message

ONE = 2.0  # m between the planes of two outlines below which they are of one vehicle


@dataclass(frozen=True, eq=False)
class Belief:
    """A Gaussian of the rig's moves, or what makes it one: the ``precision`` (Q, Q), and that times the mean, the
    ``score`` (Q,)."""

    precision: Array
    score: Array

    def __add__(self, other: Belief) -> Belief:
        return Belief(self.precision + other.precision, self.score + other.score)

    def __sub__(self, other: Belief) -> Belief:
        return Belief(self.precision - other.precision, self.score - other.score)

    @property
    def covariance(self) -> Array:
        return np.asarray(np.linalg.inv(self.precision))

    @property
    def mean(self) -> Array:
        return np.asarray(np.linalg.solve(self.precision, self.score))


def stated(Q: int) -> Belief:
    """What rig.yaml states: no move in any of ``Q`` directions, by one standard uncertainty."""
    return Belief(np.eye(Q), np.zeros(Q))


def evidence(told: RigTold) -> Belief:
    """What a vehicle's pictures add to any belief; its own moves were found under what is stated."""
    return Belief(told.information, told.information @ told.moves + told.moves)


def pull(belief: Belief, more: Belief) -> float:
    """By how many standard deviations, at most, ``more`` evidence moves the rig away from a ``belief``: in independent
    directions, of those that it tells something of."""
    root = np.linalg.cholesky(belief.covariance)
    information, axes = np.linalg.eigh(root.T @ more.precision @ root)
    information = np.maximum(information, 0.0)
    moved = axes.T @ np.linalg.solve(root, (belief + more).mean - belief.mean)
    share = information / (1.0 + information)
    told = share > UNTOLD
    return float((np.abs(moved[told]) / np.sqrt(share[told])).max(initial=0.0))


def agreed(
    told: Sequence[Belief], max_shift_sigma: float = DEFAULTS.limits.rig_shift_sigma
) -> tuple[Belief, NDArray[np.bool_]]:
    """What all that was ``told`` of one rig amounts to, what is stated included, and which (V,) of it went in: the one
    that contradicts the others most is left out, and the next. Where only two are left that contradict each other none
    goes in, for nothing says which is right."""
    kept, prior = np.full(len(told), True), stated(len(told[0].score))
    while kept.sum() > 1:
        belief = sum((t for t, k in zip(told, kept, strict=True) if k), prior)
        against = np.array([pull(belief - t, t) if k else 0.0 for t, k in zip(told, kept, strict=True)])
        if against.max() <= max_shift_sigma:
            return belief, kept
        kept[np.argmax(against)] = False
    return prior, np.full(len(told), False)


def put_right(m: Measurement, belief: Belief) -> Measurement:
    """``m`` where the rig is as it is believed to be, with what that leaves open for its systematic part."""
    assert m.rig is not None
    further, left = belief.mean - m.rig.moves, belief.covariance
    systematic = float(np.sqrt(m.rig.speed @ left @ m.rig.speed))
    half = float(np.hypot(m.rig.half, ndtri(0.5 + CONFIDENCE / 2) * systematic))
    speed = m.speed + float(m.rig.speed @ further)
    of_rows = np.einsum("nq,qr,nr->n", m.rig.speeds, left, m.rig.speeds)
    gained = m.rig.speeds @ further
    ends = np.flatnonzero(np.isfinite(gained))[[0, -1]]
    speeds, stds = m.track.refined_speed + gained, np.sqrt(m.rig.stds**2 + of_rows)
    return replace(
        m,
        track=replace(m.track, refined_speed=speeds, refined_std=stds),
        speed=speed,
        speed_lo=speed - half,
        speed_hi=speed + half,
        random_std=m.rig.std,
        systematic_std=systematic,
        acceleration=m.acceleration + float(np.diff(gained[ends])[0] / np.diff(m.track.time[ends])[0]),
    )


def beside(
    m: Measurement, others: Iterable[Measurement], settings: JointCalibrationSettings = DEFAULTS.joint_calibration
) -> list[Measurement]:
    """Those of the ``others`` that tell of the rig as it was when ``m`` passed, the nearest in time first: none twice,
    however often it is outlined."""
    apart = [(abs(float(o.track.time.mean() - m.track.time.mean())), o) for o in others if o.rig is not None]
    found: list[Measurement] = []
    for away, other in sorted(apart, key=lambda pair: pair[0]):
        if away > settings.window_s or len(found) == settings.neighbours:
            break
        if not any(is_one(other.track, known.track) for known in [m, *found]):
            found.append(other)
    return found


def is_one(track: Track, other: Track) -> bool:
    """Whether two tracks are of one vehicle, by the frames that they have in common."""
    _, here, there = np.intersect1d(track.frame, other.frame, return_indices=True)
    apart = np.linalg.norm(track.position[here] - other.position[there], axis=1)
    return len(apart) > 0 and float(np.median(apart)) < ONE


def among(m: Measurement, others: Iterable[Measurement], configuration: SpeedConfiguration = DEFAULTS) -> Measurement:
    """``m`` with what the vehicles ``beside`` it tell of the rig, too, and judged anew by that: rejected if it
    contradicts them, or all of them what rig.yaml states. As it is where no two agree."""
    if m.rig is None:
        return m
    told = [evidence(o.rig) for o in [*beside(m, others, configuration.joint_calibration), m] if o.rig is not None]
    belief, agree = agreed(told, configuration.limits.rig_shift_sigma)
    if not agree.any():
        return m
    count, prior = int(agree.sum()), stated(len(m.rig.moves))
    limit = configuration.limits.rig_shift_sigma
    if not agree[-1]:
        by = pull(belief, told[-1])
        reason = message("calibration_differs_between_vehicles", deviation=by, max_deviation=limit)
    elif (by := pull(prior, belief - prior)) > limit:
        reason = message("calibration_inconsistent_jointly", vehicles=count, deviation=by, max_deviation=limit)
    else:
        own, m = m.rig.half, replace(put_right(m, belief), calibrated_by=count)
        reason = verdict.check_interval(m.speed, (m.speed_hi - m.speed_lo) / 2, own, configuration.limits)
    return replace(m.judged(reason), rig=None)


def together(measurements: Sequence[Measurement], configuration: SpeedConfiguration = DEFAULTS) -> list[Measurement]:
    """The vehicles of one recording with what they tell of its rig in common."""
    return [among(m, [o for o in measurements if o is not m], configuration) for m in measurements]
