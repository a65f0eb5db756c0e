"""The observation model of [Zhu] section III-B: part-wise wavelet features in each view, correlation across them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Floats
from paceline.cameras import StereoRig
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import patch_features_cpu
from paceline.speed.filter.motion_models import State, cross_homographies
from paceline.speed.geometry.quadrilaterals_cpu import inward_edges, unit_square_to

PackedImage = patch_features_cpu.PackedImage
Views = tuple[PackedImage, PackedImage]  # left and right

SAMPLES_PER_REGION = 2560  # about this many samples a region, 64 × 40 in [Zhu]'s terms
CONTRAST_FLOOR = 0.3  # share of the median part's contrast; a part below it has a smaller weight, as it is mostly noise
PART_DISTANCE_CAP = 1.0  # greatest D² of a part, so that an occluded part has a limited effect


@dataclass(frozen=True)
class PartGrid:
    """``across`` × ``down`` parts of 4 × 4 blocks, each block of ``samples`` (x, y)."""

    across: int
    down: int
    samples: tuple[int, int]

    @classmethod
    def for_region(cls, parts: int, quad: Array) -> PartGrid:
        """The division of N_p ``parts`` whose parts come out most nearly square on ``quad`` (4, 2)."""
        width = np.linalg.norm(quad[1] - quad[0]) + np.linalg.norm(quad[2] - quad[3])
        height = np.linalg.norm(quad[3] - quad[0]) + np.linalg.norm(quad[2] - quad[1])
        pairs = [(a, parts // a) for a in range(1, parts + 1) if parts % a == 0]
        across, down = min(pairs, key=lambda p: abs(np.log(width * p[1] / (height * p[0]))))
        per_block = SAMPLES_PER_REGION / (16 * parts)
        x = max(2, round(np.sqrt(per_block * width * down / (height * across))))
        return cls(across, down, (x, max(2, round(per_block / x))))

    @property
    def parts(self) -> int:
        return self.across * self.down


@dataclass(frozen=True, eq=False)
class Observation:
    """Features (N, 2, parts, 16), normalised, of N particles in the left and right view, and their NCC (N,)."""

    features: Floats
    ncc: Floats


def pack(image: Floats, quads: Array | None = None) -> PackedImage:
    """2×2 neighbourhoods of ``image`` (H, W), 0–255, packed for sampling.

    Given ``quads`` (N, 4, 2), only within their bounding box.
    """
    height, width = image.shape
    (left, right), (top, bottom) = (0, width), (0, height)
    if quads is not None:
        low_x, low_y, high_x, high_y = patch_features_cpu.finite_bounds(quads.reshape(-1, 2))
        (left, right), (top, bottom) = _pixel_range(low_x, high_x, width), _pixel_range(low_y, high_y, height)
    packed = PackedImage(np.empty((bottom - top, right - left), np.uint32), left, top)
    patch_features_cpu.pack(image, packed)
    return packed


def pack_views(frame: StereoFrame, bounds: Iterable[tuple[Array, Array]]) -> Views:
    """Both images of ``frame``, packed between the pixels (…, 2) of the left and of the right view in ``bounds``."""
    left, right = (np.concatenate([places.reshape(-1, 2) for places in side]) for side in zip(*bounds, strict=True))
    return pack(frame.left, left), pack(frame.right, right)


def _pixel_range(low: float, high: float, size: int) -> tuple[int, int]:
    """First and last pixel, the last excluded, of an axis of ``size`` pixels that sampling between ``low`` and
    ``high`` may read.

    Places beyond the border read the pixels at the border; where there is no place, any pixels will do.
    """
    first, last = (low, high) if low <= high else (0.0, 0.0)
    return int(min(max(first - 2, 0), max(size - 2, 0))), int(min(max(last + 3, 2), size))


def observe(
    left: PackedImage, right: PackedImage, quads_left: Array, quads_right: Array, cross: Array, grid: PartGrid
) -> Observation:
    """Features and correlation of N particles in the packed images.

    ``quads_left``, ``quads_right`` (N, 4, 2) are the 2-D substates, ``cross`` (N, 3, 3) the homographies H_c (15).
    """
    N = len(quads_left)
    H = np.empty((N, 3, 3, 3), np.float32)
    to_left = unit_square_to(quads_left)
    H[:, 0], H[:, 1], H[:, 2] = to_left, unit_square_to(quads_right), cross @ to_left
    edges = inward_edges(quads_right).astype(np.float32)
    # a degenerate region has no homography: it is sampled at one pixel, which resembles nothing
    invalid = ~(np.isfinite(H).all((1, 2, 3)) & np.isfinite(edges).all((1, 2)))
    H[invalid] = [[0, 0, 0], [0, 0, 0], [0, 0, 1]]
    edges[invalid] = [0, 0, -1]
    features = np.empty((N, 2, grid.parts, 16), np.float32)
    ncc = np.empty(N, np.float32)
    patch_features_cpu.observe(
        left, right, H.reshape(N, 3, 9), edges, grid.across, grid.down, grid.samples, features, ncc
    )
    _normalise(features)
    return Observation(features, ncc)


def normalised(features: Floats) -> Floats:
    """Wavelet features (…, parts, 16) without each view's brightness and contrast.

    The median over all parts is subtracted from the averages, then each part is divided by its contrast; a part with
    much less contrast than the median keeps a smaller norm, so that its noise is not amplified. Medians, because an
    occluded part must not change the others.
    """
    f = np.array(features, np.float32, order="C")
    _normalise(f)
    return f


def _normalise(features: Floats) -> None:
    """`normalised`, in place."""
    patch_features_cpu.normalise(features.reshape(-1, *features.shape[-2:]), np.float32(CONTRAST_FLOOR))


def distances(features: Floats, reference: Floats) -> Floats:
    """D² of (13) in each view, (N, 2): the sum over parts, each limited to PART_DISTANCE_CAP.

    ``features`` (N, 2, parts, 16) and ``reference`` (2, parts, 16) are normalised.
    """
    out = np.empty((2, len(features)), np.float32)
    for view in (0, 1):
        patch_features_cpu.capped_distances(
            features[:, view], reference[view], np.float32(PART_DISTANCE_CAP), out[view]
        )
    return out.T


def log_likelihood(observation: Observation, reference: Floats, lambda_single: float, lambda_cross: float) -> Array:
    """log p(z | x) (N,) by (12), (13), (18): both single-view terms and the cross-view term."""
    single = distances(observation.features, reference).sum(-1)
    return np.asarray(-lambda_single * single - lambda_cross * (1.0 - observation.ncc) ** 2, float)


class ObservationModel:
    """The likelihood (12) of one vehicle's particles: observed features compared with those of a reference.

    ``reference`` (2, parts, 16) are the vehicle's features in the left and right view; they follow its appearance
    slowly (14).
    """

    def __init__(self, rig: StereoRig, grid: PartGrid, configuration: SpeedConfiguration) -> None:
        self.rig, self.grid = rig, grid
        self.lambda_single, self.lambda_cross = configuration.lambda_single, configuration.lambda_cross
        self.memory = configuration.reference_memory  # ε of (14)
        self.reference: Floats = np.zeros((2, grid.parts, 16), np.float32)

    def observe(self, views: Views, state: State) -> Observation:
        """What the particles ``state`` observe in ``views``."""
        left, right = views
        return observe(left, right, state.left, state.right, cross_homographies(self.rig, state), self.grid)

    def log_likelihood(self, views: Views, state: State) -> Array:
        """log p(z | x) (N,) of the particles ``state``."""
        return log_likelihood(self.observe(views, state), self.reference, self.lambda_single, self.lambda_cross)

    def initialize(self, views: Views, state: State) -> None:
        """Sets the reference to the features of a state of one particle."""
        self.reference = self.observe(views, state).features[0]

    def similarity(self, features: Floats) -> float:
        """Correlation, −1 … 1, of ``features`` (2, parts, 16) with the reference, the mean of both views."""
        both = np.stack([features, self.reference]).reshape(2, 2, -1)  # (observed and reference, views, features)
        norms = np.linalg.norm(both, axis=2).prod(0)
        return float(((both[0] * both[1]).sum(1) / np.maximum(norms, 1e-6)).mean())

    def update(self, features: Floats) -> None:
        """Update the reference by the observed ``features`` (14)."""
        self.reference = self.memory * self.reference + (1 - self.memory) * features
