"""Whether a rig still stands as it was calibrated, by points of the scene; and its rotation set right by them.

A point seen by one camera lies on a line in the other, whatever its distance. Where the rig has turned, points lie
off their lines: by a constant after a nod, in proportion to x after a roll. A turn about the upright axis moves them
along their lines, like a change of distance, and shows only weakly, at the image's corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from paceline.arrays import Array, Mask
from paceline.blas import on_one_blas_thread
from paceline.calibration.scene_matches import Matches
from paceline.calibration.speed_sensitivity import SpeedEffect, speed_effects, stated_uncertainty
from paceline.cameras import RigUncertainty, StereoRig, perturbed_rig
from paceline.geometry import epipolar_distance

LEAST_MATCHES, LEAST_TILES = 30, 12
FAR = 3.0  # standard deviations at which a match counts a quarter
WRONG = 4.0  # standard deviations beyond which it is counted as a mistake
STEPS = 30
UNLIKELY = 1e-3  # chance of so large a difference in a rig that has not moved, below which it is said to have
# Tangential distortion p2 moves points off their lines as a turn of 2 p2 about the upright axis would, and no lens
# model is surer of the two cameras' than this.
TANGENTIAL = 7e-4
SMALL = 1e-6  # of a rotation (rad), for differences
DIFFERENCES = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, SMALL, SMALL, SMALL, 1e-5, 1e-5, 1e-5])
AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Check:
    """What the scene says of a rig.

    ``turn`` (3,) rad is by how much the right camera seems to have turned about its x, y, z axes; ``scene_covariance``
    (3, 3) is how well the scene tells that, ``rig_covariance`` (3, 3) what the calibration's own uncertainty explains.
    ``chance`` is that of so large a turn in a rig that stands as calibrated. ``scatter`` px is the standard deviation
    of a match off its line once the turn is taken away, ``error`` px the root mean square that the turn causes.
    ``response`` (3, 14) is ∂turn/∂(the rig's parameters).
    """

    matches: int
    mistakes: int
    tiles: int
    turn: Array
    scene_covariance: Array
    rig_covariance: Array
    response: Array
    chance: float
    scatter: float
    error: float
    states_uncertainty: bool

    @property
    def moved(self) -> bool:
        return self.chance < UNLIKELY

    @property
    def std(self) -> Array:
        """Standard uncertainties (3,) rad of the turn, the calibration's own included."""
        return np.asarray(np.sqrt(np.diag(self.scene_covariance + self.rig_covariance)))


@dataclass(frozen=True, eq=False)
class Refinement:
    """A rig turned as the scene says, by ``turn`` (3,) rad with standard uncertainties ``std`` (3,), and ``from_scene``
    (3,), the share of what is known about each angle that the scene contributed."""

    rig: StereoRig
    turn: Array
    std: Array
    from_scene: Array
    effects: list[SpeedEffect]


def enough(matches: Matches) -> bool:
    """Whether the scene holds enough to judge a rig by."""
    return len(matches) >= LEAST_MATCHES and len(np.unique(matches.tile)) >= LEAST_TILES


@on_one_blas_thread
def check(rig: StereoRig, matches: Matches) -> Check:
    """How far the right camera of ``rig`` has turned, by robust least squares of the distances from epipolar lines."""
    turn, keep, scatter = _fit_turn(rig, matches)
    kept = matches.where(keep)
    at = turned(rig, turn)
    J = _by_turn(at, kept)
    residuals = epipolar_distance(at, kept.left, kept.right)
    scene = clustered_covariance(J, residuals, kept.tile)
    doubt = np.linalg.pinv(J) @ _by_lens_doubt(at, kept)
    scene += np.outer(doubt, doubt)
    response = np.linalg.pinv(J) @ _by_parameters(at, kept)  # how errors of the file show as a turn
    uncertainty = rig.uncertainty or RigUncertainty()
    moves = response @ uncertainty.covariance_root.T
    of_rig = moves @ moves.T
    tiles = len(np.unique(kept.tile))
    distance = float(turn @ np.linalg.solve(scene + of_rig, turn))
    chance = float(f_distribution.sf(distance / 3 * (tiles - 3) / (tiles - 1), 3, tiles - 3))  # Hotelling's T²
    return Check(
        matches=len(kept),
        mistakes=len(matches) - len(kept),
        tiles=tiles,
        turn=turn,
        scene_covariance=scene,
        rig_covariance=of_rig,
        response=response,
        chance=chance,
        scatter=scatter,
        error=float(np.sqrt(((J @ turn) ** 2).mean())),
        states_uncertainty=rig.uncertainty is not None,
    )


@on_one_blas_thread
def refine(rig: StereoRig, found: Check) -> Refinement:
    """``rig`` with its rotation set right by the scene, and the uncertainty that it then has.

    The rig's own calibration is what is known before. Where it has moved, it is known less: a knock turns a camera
    about every axis alike, so that what it did about the axes that the scene shows well says how much it may have done
    about the one that it does not. Only the rotation is changed; the doubt about all else stays (a filter that
    "considers" it: S. F. Schmidt, 1966).
    """
    U = (rig.uncertainty or RigUncertainty()).covariance_root
    prior = U.T @ U
    if found.moved or not found.states_uncertainty:
        knock = found.turn**2 - (np.diag(found.scene_covariance + found.rig_covariance) if found.moved else 0.0)
        prior[8:11, 8:11] += max(float(knock[[0, 2]].max()), SMALL**2) * np.eye(3)
    G = found.response
    S = G @ prior @ G.T + found.scene_covariance
    gain = np.zeros((14, 3))
    gain[8:11] = (prior @ G.T @ np.linalg.inv(S))[8:11]
    keep = np.eye(14) - gain @ G
    posterior = keep @ prior @ keep.T + gain @ found.scene_covariance @ gain.T
    turn = gain[8:11] @ found.turn
    before, after = np.diag(prior)[8:11], np.diag(posterior)[8:11]
    better = turned(rig, turn)
    better = StereoRig(better.left, better.right, better.R, better.t, stated_uncertainty(better, posterior))
    share = 1 - after / np.maximum(before, 1e-300)
    return Refinement(better, turn, np.sqrt(after), np.clip(share, 0.0, 1.0), speed_effects(better))


def turned(rig: StereoRig, turn: Array) -> StereoRig:
    """``rig`` with its right camera turned about its own axes by ``turn`` (3,) rad, where it stands."""
    R = np.asarray(cv2.Rodrigues(turn)[0])
    return StereoRig(rig.left, rig.right, R @ rig.R, R @ rig.t, rig.uncertainty)


def _fit_turn(rig: StereoRig, matches: Matches) -> tuple[Array, Mask, float]:
    """The turn (3,), which matches agree with it, and their standard deviation from their lines, px."""
    turn = np.zeros(3)
    e = epipolar_distance(rig, matches.left, matches.right)
    scale = 1.4826 * float(np.median(np.abs(e - np.median(e))))  # about a common offset, which a nod explains
    for _ in range(STEPS):
        at = turned(rig, turn)
        e = epipolar_distance(at, matches.left, matches.right)
        J = _by_turn(at, matches)
        w = 1.0 / (1.0 + (e / (FAR * scale)) ** 2) ** 2
        step = -np.linalg.solve((J * w[:, None]).T @ J, (J * w[:, None]).T @ e)
        turn = turn + step
        scale = 1.4826 * float(np.median(np.abs(e + J @ step)))
        if np.abs(step).max() < 1e-9:
            break
    keep = np.abs(epipolar_distance(turned(rig, turn), matches.left, matches.right)) < WRONG * scale
    kept = matches.where(keep)
    for _ in range(3):  # the same without weights, so that the covariance is that of least squares
        at = turned(rig, turn)
        J = _by_turn(at, kept)
        turn = turn - np.linalg.lstsq(J, epipolar_distance(at, kept.left, kept.right), rcond=None)[0]
    return turn, keep, float(np.std(epipolar_distance(turned(rig, turn), kept.left, kept.right)))


def clustered_covariance(J: Array, residuals: Array, cluster: NDArray[np.int64]) -> Array:
    """Covariance (P, P) of the least-squares solution with the design ``J`` (N, P), the ``residuals`` (N,) that it
    leaves being alike within each ``cluster`` (N,): the sandwich with the usual correction for few clusters."""
    _, numbers = np.unique(cluster, return_inverse=True)
    scores = np.zeros((numbers.max() + 1, J.shape[1]))
    np.add.at(scores, numbers, J * residuals[:, None])
    n, (N, P) = len(scores), J.shape
    bread = np.linalg.inv(J.T @ J)
    return np.asarray(bread @ (scores.T @ scores) @ bread * n / (n - 1) * (N - 1) / (N - P))


def _by_lens_doubt(rig: StereoRig, matches: Matches) -> Array:
    """Change (N,) px of the distance from the epipolar line by a tangential distortion p2 of ``TANGENTIAL``."""
    K = rig.right.K
    x, y = rig.right.rays(matches.right)[:, :2].T
    shift = TANGENTIAL * np.stack([K[0, 0] * (3 * x * x + y * y), K[1, 1] * 2 * x * y], axis=-1)
    before = epipolar_distance(rig, matches.left, matches.right)
    return np.asarray(epipolar_distance(rig, matches.left, matches.right + shift) - before)


def _by_turn(rig: StereoRig, matches: Matches) -> Array:
    """∂(distance from the epipolar line)/∂turn (N, 3), px/rad."""
    return _by_parameters(rig, matches)[:, 8:11]


def _by_parameters(rig: StereoRig, matches: Matches) -> Array:
    """∂(distance from the epipolar line)/∂(the rig's 14 parameters) (N, 14)."""
    ends = []
    for sign in (1, -1):
        moves = sign * np.diag(DIFFERENCES)
        ends.append([epipolar_distance(perturbed_rig(rig, m), matches.left, matches.right) for m in moves])
    return np.asarray(((np.array(ends[0]) - np.array(ends[1])) / (2 * DIFFERENCES[:, None])).T)
