"""The direction of the road, by voting as in a Hough transform: the arc to which most thin bright ridges on the ground
are parallel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.lanes.inverse_perspective import GroundImage, map_to_ground
from paceline.lanes.road_alignment import Alignment
from paceline.lanes.road_surface import RoadSurface
from paceline.recordings.background import Background

GROUND_CELL_M = 0.06  # cell size of the ground image
MIN_DISTANCE_M, MAX_DISTANCE_M, MAX_LATERAL_M = 4.0, 90.0, 40.0  # part of the ground that is searched
RIDGE_SCALE_M = 0.07  # sigma of the Gaussian: a little more than half a marking's width
MIN_RIDGE_STRENGTH = 0.03
MAX_COUNTED_STRENGTH = 0.1  # strength above which a ridge has no more weight
MIN_STRENGTH_RATIO = 3.0  # least ratio to the mean strength in the neighbourhood
RIDGE_NEIGHBOURHOOD_M = 3.0  # size of that neighbourhood
MAX_CURVATURE_RATIO = 0.5  # of the light's second derivative along a ridge to that across it
MAX_FULL_WEIGHT_PIXEL_M = 0.3  # of ground along the viewing direction in one pixel, beyond which a ridge counts less
MAX_VOTES = 5000
MIN_VOTES = 40
GRID_SEARCH_VOTES = 1000  # that are used in the search over all headings and curvatures
HEADINGS_RAD = np.radians(np.arange(-90.0, 90.0, 1.0))
CURVATURES_PER_M = np.linspace(-1, 1, 61) / 22.0
HILL_CLIMB_STARTS, HILL_CLIMB_STEPS = 10, 9
ANGLE_STD_RAD = np.radians(4.0)  # of a ridge relative to the road
COARSE_BIN_M, MEDIUM_BIN_M, FINE_BIN_M = 0.5, 0.25, 0.12  # of the histogram, from the search to its end


def estimate_direction(rig: StereoRig, background: Background, surface: RoadSurface) -> Alignment | None:
    """The road's alignment, to some decimetres over its visible length; None where there are no line-like ridges."""
    votes = ridge_points(rig, background, surface)
    if len(votes.ground) < MIN_VOTES:
        return None
    return votes.best_alignment()


@dataclass(frozen=True, eq=False)
class DirectionVotes:
    """Points of paint on the ground (N, 2), the angles (N,) of the paint at them, and their ``weight`` (N,)."""

    ground: Array
    angle: Array
    weight: Array

    def best_alignment(self) -> Alignment:
        """The arc, with its deviation, that the votes agree on best."""
        votes, place = self.subsample(MAX_VOTES), np.median(self.ground, axis=0)
        subsample = votes.subsample(GRID_SEARCH_VOTES)
        grid = [Alignment(place, heading, curvature) for heading in HEADINGS_RAD for curvature in CURVATURES_PER_M]
        scores = np.array([subsample.concentration(alignment, COARSE_BIN_M) for alignment in grid])
        climbed = [votes.hill_climb(grid[i]) for i in np.argsort(-scores)[:HILL_CLIMB_STARTS]]
        return votes.refine(max(climbed, key=lambda alignment: votes.concentration(alignment, FINE_BIN_M)))

    def subsample(self, count: int) -> DirectionVotes:
        """About ``count`` of the points, drawn at random with a fixed seed."""
        chosen = np.random.default_rng(0).random(len(self.weight)) < count / len(self.weight)
        return DirectionVotes(self.ground[chosen], self.angle[chosen], self.weight[chosen])

    def concentration(self, alignment: Alignment, cell: float) -> float:
        """How well the points that run along ``alignment`` concentrate on few lines parallel to it: the sum of squares
        of their histogram over d in cells of ``cell`` m, each point shared between two so that it is smooth."""
        s, d = alignment.from_ground(self.ground)
        angle_offset = self.angle - alignment.direction(s)
        angle_offset -= np.pi * np.round(angle_offset / np.pi)
        weight = self.weight * np.exp(-0.5 * (angle_offset / ANGLE_STD_RAD) ** 2)
        position = (d - d.min()) / cell
        low = position.astype(np.int64)
        part, cells = position - low, int(low.max()) + 2
        count = np.bincount(low, weight * (1 - part), cells) + np.bincount(low + 1, weight * part, cells)
        return float(count @ count)

    def hill_climb(self, start: Alignment) -> Alignment:
        """The best alignment near ``start``, by a pattern search that halves its steps."""
        best, score = start, self.concentration(start, FINE_BIN_M)
        turn, bend = (HEADINGS_RAD[1] - HEADINGS_RAD[0]) / 2, (CURVATURES_PER_M[1] - CURVATURES_PER_M[0]) / 2
        for _ in range(HILL_CLIMB_STEPS):
            around = [
                replace(best, heading=best.heading + a * turn, curvature=best.curvature + b * bend)
                for a, b in product((-1, 0, 1), repeat=2)
                if a or b
            ]
            scores = [self.concentration(alignment, FINE_BIN_M) for alignment in around]
            top = int(np.argmax(scores))
            if scores[top] > score:
                best, score = around[top], scores[top]
            else:
                turn, bend = turn / 2, bend / 2
        return best

    def refine(self, start: Alignment) -> Alignment:
        """The best alignment near ``start`` that may also deviate from its arc, slowly."""
        step = np.array([np.radians(0.5), 3e-4, 0.3, 0.1])

        def bent(x: Array) -> Alignment:
            heading, curvature, third, fourth = x * step
            deviation = start.deviation + [0.0, 0.0, 0.0, third, fourth]
            return replace(
                start, heading=start.heading + heading, curvature=start.curvature + curvature, deviation=deviation
            )

        x = np.zeros(4)
        for cell in (COARSE_BIN_M, MEDIUM_BIN_M, FINE_BIN_M):
            optimum = minimize(
                lambda x, cell=cell: -self.concentration(bent(x), cell) * np.exp(-0.01 * x @ x),
                x,
                method="Nelder-Mead",
                options={"initial_simplex": np.vstack([x, x + np.eye(4)]), "maxfev": 150, "xatol": 0.02, "fatol": 0.0},
            )
            x = optimum.x
        return bent(x)


def ridge_points(rig: StereoRig, background: Background, surface: RoadSurface) -> DirectionVotes:
    """Thin bright ridges at the same ground position in both views; those of objects above the ground differ."""
    x, z = (
        np.arange(-MAX_LATERAL_M, MAX_LATERAL_M, GROUND_CELL_M),
        np.arange(MIN_DISTANCE_M, MAX_DISTANCE_M, GROUND_CELL_M),
    )
    ground = np.stack(np.meshgrid(x, z), axis=-1)
    views = [_ridges(map_to_ground(rig, background, side, surface, ground)) for side in (0, 1)]
    dilated = [cv2.dilate(strength, np.ones((3, 3), np.uint8)) for strength, _ in views]
    row, column = np.nonzero((views[0][0] > 0) & (dilated[1] > 0))
    strength, angle = (values[row, column].astype(float) for values in views[0])
    strength = np.minimum(strength, dilated[1][row, column])
    # far away a pixel covers much ground, and its neighbours on the grid are no further evidence
    covered = z[row] ** 2 / (rig.left.K[1, 1] * np.linalg.norm(surface.origin))
    return DirectionVotes(
        ground[row, column],
        angle,
        np.minimum(strength, MAX_COUNTED_STRENGTH) * np.minimum(1.0, MAX_FULL_WEIGHT_PIXEL_M / covered),
    )


def _ridges(ground_image: GroundImage) -> tuple[Image, Image]:
    """Strength (H, W) of a view's ridges on their crests, 0 elsewhere, and the angle they run at (rad, from ahead to
    the right)."""
    light = cv2.GaussianBlur(ground_image.log_intensity, (0, 0), RIDGE_SCALE_M / GROUND_CELL_M)
    scale = (RIDGE_SCALE_M / GROUND_CELL_M) ** 2 / 4
    xx, zz, xz = (scale * cv2.Sobel(light, cv2.CV_32F, i, j, ksize=3) for i, j in ((2, 0), (0, 2), (1, 1)))
    mean, half = (xx + zz) / 2, np.hypot((xx - zz) / 2, xz)
    strength, along = np.maximum(half - mean, 0), np.abs(half + mean)  # the Hessian's eigenvalues
    window = (round(RIDGE_NEIGHBOURHOOD_M / GROUND_CELL_M),) * 2
    known = cv2.blur(ground_image.visible.astype(np.float32), window)
    mean_strength = cv2.blur(strength * ground_image.visible, window) / np.maximum(known, 1e-3)
    interior = cv2.erode(ground_image.visible.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    ridge = (
        interior
        & (strength > MIN_RIDGE_STRENGTH)
        & (strength > MIN_STRENGTH_RATIO * mean_strength)
        & (along < MAX_CURVATURE_RATIO * strength)
    )
    normal = 0.5 * np.arctan2(-2 * xz, zz - xx)  # of the eigenvector across, from x towards z
    row, column = np.nonzero(ridge)
    step = np.sin(normal[row, column]), np.cos(normal[row, column])
    neighbours = [map_coordinates(strength, [row + k * step[0], column + k * step[1]], order=1) for k in (-1, 1)]
    crest = strength[row, column] >= np.maximum(*neighbours)
    ridges = np.zeros_like(strength)
    ridges[row[crest], column[crest]] = strength[row[crest], column[crest]]
    return ridges, -normal
