"""One rig, many vehicles: what all their pictures together tell of the calibration puts each of their speeds right.

Each vehicle's fit is a Gaussian in its own motion and in the rig's moves (`speed/free_rig.py`). The rig is the same for
all of them, so that what their pictures tell of it adds up, and each motion follows where all of them move the rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from paceline.speed import verdict
from paceline.speed.results import CONFIDENCE, Measurement, RigTold

Array = NDArray[np.float64]

CONTRADICTED = 5.0  # standard deviations that one vehicle's pictures may want the rig away from where the others do
UNTOLD = 0.05  # share of the variance in a direction that pictures have to take away to tell anything of it


@dataclass(frozen=True, eq=False)
class Belief:
    """A Gaussian of the rig's moves: its ``precision`` (Q, Q), and that times its mean, the ``score`` (Q,)."""

    precision: Array
    score: Array

    @property
    def covariance(self) -> Array:
        return np.asarray(np.linalg.inv(self.precision))

    @property
    def mean(self) -> Array:
        return np.asarray(np.linalg.solve(self.precision, self.score))

    def taking(self, told: RigTold, times: float = 1.0) -> Belief:
        """With what is ``told`` taken in; with ``times`` −1, taken out again."""
        of_it = told.information @ told.moves + told.moves  # it is found under the stated prior
        return Belief(self.precision + times * told.information, self.score + times * of_it)


def stated(Q: int) -> Belief:
    """What rig.yaml states: no move in any of ``Q`` directions, by one standard uncertainty."""
    return Belief(np.eye(Q), np.zeros(Q))


def contradiction(told: RigTold, others: Belief) -> float:
    """By how many standard deviations, at most, one vehicle's pictures move the rig away from where the ``others``
    have it: in independent directions, of those that its pictures tell something of."""
    root = np.linalg.cholesky(others.covariance)
    information, axes = np.linalg.eigh(root.T @ told.information @ root)
    moved = axes.T @ np.linalg.solve(root, others.taking(told).mean - others.mean)
    share = np.maximum(information, 0.0) / (1.0 + np.maximum(information, 0.0))
    known = share > UNTOLD
    return float((np.abs(moved[known]) / np.sqrt(share[known])).max(initial=0.0))


def agreed(told: Sequence[RigTold]) -> tuple[Belief, NDArray[np.bool_]]:
    """What all that was ``told`` of one rig amounts to, and which (V,) of it went in: the one that contradicts the
    others most is left out, and the next. Where only two are left that contradict each other none goes in, for nothing
    says which is right."""
    kept = np.full(len(told), True)
    Q = len(told[0].moves) if len(told) else 0
    while kept.sum() > 1:
        belief = reduce(Belief.taking, (t for t, k in zip(told, kept, strict=True) if k), stated(Q))
        against = np.zeros(len(told))
        for v, t in enumerate(told):
            against[v] = contradiction(t, belief.taking(t, -1.0)) if kept[v] else 0.0
        if against.max() <= CONTRADICTED:
            return belief, kept
        if kept.sum() == 2:
            break
        kept[np.argmax(against)] = False
    return stated(Q), np.full(len(told), False)


def put_right(m: Measurement, belief: Belief) -> Measurement:
    """``m`` where the rig is as it is believed to be, with what that leaves open for its systematic part."""
    assert m.rig is not None
    further, left = belief.mean - m.rig.moves, belief.covariance
    systematic = float(np.sqrt(m.rig.speed @ left @ m.rig.speed))
    half = float(np.hypot(m.rig.half, ndtri(0.5 + CONFIDENCE / 2) * systematic))
    speed = m.speed + float(m.rig.speed @ further)
    of_rows = np.einsum("nq,qr,nr->n", m.rig.speeds, left, m.rig.speeds)
    speeds = m.track.refined_speed + m.rig.speeds @ further
    fitted = np.flatnonzero(np.isfinite(speeds))[[0, -1]]
    gained = (m.rig.speeds @ further)[fitted]
    return replace(
        m,
        track=replace(m.track, refined_speed=speeds, refined_std=np.sqrt(m.rig.stds**2 + of_rows)),
        speed=speed,
        speed_lo=speed - half,
        speed_hi=speed + half,
        random_std=m.rig.std,
        systematic_std=systematic,
        acceleration=m.acceleration + float(np.diff(gained)[0] / np.diff(m.track.time[fitted])[0]),
    )


def together(measurements: Sequence[Measurement]) -> list[Measurement]:
    """The vehicles of one recording with what they tell of its rig in common; as they were where no two agree."""
    told = {i: m.rig for i, m in enumerate(measurements) if m.rig is not None}
    belief, agree = agreed(list(told.values()))
    shared = list(measurements)
    if agree.any():
        for i, agrees in zip(told, agree, strict=True):
            shared[i] = _among(shared[i], belief, int(agree.sum()) if agrees else 0)
    return shared


def after(m: Measurement, before: Sequence[RigTold]) -> Measurement:
    """``m`` with what those ``before`` it told of the rig, too; as it is where no two agree."""
    if m.rig is None:
        return m
    belief, agree = agreed([*before, m.rig])
    return _among(m, belief, int(agree.sum()) if agree[-1] else 0) if agree.any() else m


def _among(m: Measurement, belief: Belief, agree: int) -> Measurement:
    """``m`` as one of those that ``agree`` on this ``belief`` of the rig: put right, and judged anew by how wide its
    interval is then; rejected if they are 0, for it is none of them."""
    if m.rig is None or not agree:
        reason = "calibration: its pictures want the cameras elsewhere than those of the other vehicles do"
    else:
        own, m = m.rig.half, replace(put_right(m, belief), calibrated_by=agree)
        reason = verdict.too_wide(m.speed, (m.speed_hi - m.speed_lo) / 2, own)
    return replace(m, verdict="rejected" if reason else "measured", reason=reason, rig=None)
