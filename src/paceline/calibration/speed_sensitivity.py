"""The effect of a calibration's uncertainty on speeds, and the ``uncertainty`` entry of rig.yaml.

Everything that uses a rig works with pinhole cameras: images are undistorted once, with the estimated distortion. An
error of the distortion therefore acts like the error of the pinhole camera that approximates it best over the image's
middle, and the covariance of the 24 parameters becomes one of 14 parameters: fx, fy, cx, cy of each camera, rotation
and translation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.calibration.parameters import LENS_PARAMETERS, N_LENS, N_RIG, RigState, lens_camera
from paceline.cameras import RigUncertainty, StereoRig, perturbed_rigs
from paceline.geometry import triangulate

DISTANCES_M = (20.0, 50.0, 80.0)
VERDICT_DISTANCE_M = 50.0  # one of these, at which calibrations are judged
TRAVEL_M = 10.0  # distance over which a speed is measured
LATERAL_SHARES = (-0.25, 0.0, 0.25)  # offsets from the image's centre at which vehicles drive, of its width
FITTED_IMAGE_SHARE = 0.6  # share of the image over which a pinhole camera is fitted to a lens
LENS_STEPS = np.array([1.0, 1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3])  # of central differences
N_PINHOLE = 4


@dataclass(frozen=True)
class SpeedEffect:
    """One standard uncertainty of a speed at ``distance`` (m), as a share of it: for a vehicle that drives along the
    line of sight, and for one that drives across it."""

    distance: float
    along: float
    across: float


def speed_effects(rig: StereoRig, distances: Sequence[float] = DISTANCES_M) -> list[SpeedEffect]:
    """The effect of the uncertainty of ``rig`` on speeds in the middle of the image, with the pixels held fixed:
    before any vehicle's images correct part of it."""
    assert rig.uncertainty is not None
    moves = perturbed_rigs(rig, rig.uncertainty)
    effects = []
    for distance in distances:
        along, across = (
            float(np.linalg.norm([relative_speed_change(rig, perturbed, *ends) for perturbed in moves]))
            for ends in _displacements(rig, distance, 0.0)
        )
        effects.append(SpeedEffect(distance, along, across))
    return effects


def relative_speed_change(rig: StereoRig, perturbed: StereoRig, start: Array, end: Array) -> float:
    """The relative change of the distance from ``start`` (3,) to ``end`` (3,) when the pixels of ``rig`` are
    triangulated with ``perturbed``."""
    ends = np.stack([start, end])
    triangulated = triangulate(perturbed, *rig.project(ends))
    return float(np.linalg.norm(triangulated[1] - triangulated[0]) / np.linalg.norm(end - start)) - 1


def _displacements(rig: StereoRig, distance: float, across: float) -> list[tuple[Array, Array]]:
    """Start and end of a displacement along the line of sight at ``distance`` and ``across``, and of one across it."""
    width = rig.left.image_size[0]
    x = rig.left.K[0, 2] + across * width
    middle = distance * rig.left.rays(np.array([x, rig.left.K[1, 2]]))
    half = TRAVEL_M / 2 * np.array([[0.0, 0, 1], [1, 0, 0]])
    return [(middle - h, middle + h) for h in half]


def pinhole_covariance(rig: RigState, covariance: Array, sizes: Sequence[tuple[int, int]]) -> Array:
    """Covariance (14, 14) of the pinholes' parameters, rotation and translation from that of all (24, 24)."""
    M = np.zeros((2 * N_PINHOLE + 6, N_RIG))
    for side, size in enumerate(sizes):
        rows = slice(N_PINHOLE * side, N_PINHOLE * (side + 1))
        M[rows, N_LENS * side : N_LENS * (side + 1)] = equivalent_pinhole(rig.lenses[side], size)
    M[2 * N_PINHOLE :, 2 * N_LENS :] = np.eye(6)
    return M @ covariance @ M.T


def equivalent_pinhole(lens: Array, size: tuple[int, int]) -> Array:
    """∂(fx, fy, cx, cy)/∂lens (4, 9) of the pinhole nearest to the ideal pixels that ``lens`` (9,) computes, as they
    relate to the rays of the true lens: least squares over the middle of an image of that ``size``."""
    camera = lens_camera(lens, size)
    w, h = size
    u = np.linspace((1 - FITTED_IMAGE_SHARE) / 2, (1 + FITTED_IMAGE_SHARE) / 2, 13)
    pixels = np.stack(np.meshgrid(u * (w - 1), u * (h - 1)), -1).reshape(-1, 2)
    ideal, D = camera.undistort_points(pixels), np.zeros((N_PINHOLE, len(LENS_PARAMETERS)))
    for k, step in enumerate(LENS_STEPS):
        ends = []
        for sign in (-1, 1):
            other = lens.copy()
            other[k] += sign * step
            true = lens_camera(other, size)
            rays = true.rays(true.undistort_points(pixels))
            for i in (0, 1):  # ideal = f · ray + c
                design = np.column_stack([rays[:, i], np.ones(len(rays))])
                ends.append(np.linalg.lstsq(design, ideal[:, i], rcond=None)[0])
        (fx0, cx0), (fy0, cy0), (fx1, cx1), (fy1, cy1) = ends
        D[:, k] = np.array([fx1 - fx0, fy1 - fy0, cx1 - cx0, cy1 - cy0]) / (2 * step)
    return D


def stated_uncertainty(rig: StereoRig, covariance: Array) -> RigUncertainty:
    """The ``uncertainty`` of rig.yaml: the covariance (14, 14), and beside it independent standard uncertainties for
    programs that read only these.

    A shift of a principal point and a turn of its camera are nearly one: they are stated together, as the turn. The
    focal length is given what is then still lacking, up to its own uncertainty, and all are enlarged together where no
    speed would otherwise be as unsure as by the covariance.
    """
    F = principal_points_as_turns(rig)
    std = np.sqrt(np.diag(F @ covariance @ F.T))[8:]
    turn, shift = _triple(std[:3]), _triple(std[3:])
    displacements = [
        displacement
        for distance in DISTANCES_M
        for across in LATERAL_SHARES
        for displacement in _displacements(rig, distance, across)
    ]

    def variances(stated: RigUncertainty) -> Array:
        moves = perturbed_rigs(rig, stated)
        return np.array(
            [
                sum(relative_speed_change(rig, perturbed, *displacement) ** 2 for perturbed in moves)
                for displacement in displacements
            ]
        )

    total, focal = variances(RigUncertainty(covariance=covariance)), variances(RigUncertainty(1.0))
    missing_variance = np.maximum(total - variances(RigUncertainty(0.0, 0.0, turn, shift)), 0.0)
    known = np.diag(covariance)[[0, 1, 4, 5]].max()
    length = float(np.sqrt(min(known, (missing_variance / focal).max())))
    larger = float(np.sqrt(max(1.0, (total / variances(RigUncertainty(length, 0.0, turn, shift))).max())))
    return RigUncertainty(larger * length, 0.0, _triple(larger * std[:3]), _triple(larger * std[3:]), covariance)


def principal_points_as_turns(rig: StereoRig) -> Array:
    """F (14, 14), by which changes of the parameters become nearly equal ones that leave the principal points: a shift
    of one becomes the turn of its camera that it resembles."""
    F = np.diag([1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, *np.ones(6)])
    for first, camera, sign in ((2, rig.left, -1.0), (6, rig.right, 1.0)):
        F[9, first] = sign / camera.K[0, 0]  # the right camera: ray and pixel shift alike
        F[8, first + 1] = -sign / camera.K[1, 1]
    return F


def _triple(values: Array) -> tuple[float, float, float]:
    a, b, c = (float(v) for v in values)
    return a, b, c
