"""Sweep planes across lane paths, and the photo-consistency of both views of an image pair on each of them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Mask
from paceline.detection import plane_sweep_cpu
from paceline.detection.lane_paths import PlaneGrid, pyramid_level

Pyramids = list[list[Image]]  # of the left and of the right image


@dataclass(frozen=True, eq=False)
class SweepPlane:
    """One plane of the sweep. ``homographies`` (2, 3, 3) map the cells (column, row, 1) of its ``grid`` to pixels of
    the left and of the right image; images are compared over ``window`` cells at the ``level`` of their pyramids."""

    grid: PlaneGrid
    window: int
    level: int
    homographies: Array

    def consistency_map(
        self, views: Pyramids, background: Pyramids, min_contrast: float, min_area_m2: float = 0.0
    ) -> Image:
        """How well both views agree at each cell (rows, columns), 0 to 1; 0 where either has a contrast below
        ``min_contrast`` grey levels or looks like its ``background``, and everywhere where the sum is below
        ``min_area_m2``."""
        consistency = np.empty(self.grid.size[::-1], np.float32)
        left, right, left_background, right_background = (levels[self.level] for levels in (*views, *background))
        cells = min_area_m2 / self.grid.cell**2
        plane_sweep_cpu.consistency(
            left,
            right,
            left_background,
            right_background,
            self.homographies,
            self._scale,
            self.window,
            min_contrast,
            cells,
            consistency,
        )
        return consistency

    def correlation_map(self, views: Pyramids) -> tuple[Image, Image]:
        """The local NCC of both views and the local contrast of the left one, (rows, columns) each."""
        ncc, contrast = np.empty((2, *self.grid.size[::-1]), np.float32)
        left, right = (levels[self.level] for levels in views)
        plane_sweep_cpu.correlate(left, right, self.homographies, self._scale, self.window, ncc, contrast)
        return ncc, contrast

    def weighted_ncc(self, views: Pyramids, mask: Mask) -> float:
        """The mean local NCC of both views inside ``mask`` (rows, columns), weighted by contrast, because cells with
        little of it match at any distance; −1 for an empty mask."""
        if not mask.any():
            return -1.0
        left, right = (levels[self.level] for levels in views)
        rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
        row, column = (max(int(places[0]) - self.window, 0) for places in (rows, columns))
        part = np.ascontiguousarray(mask[row : rows[-1] + 1 + self.window, column : columns[-1] + 1 + self.window])
        shifted = self.homographies @ np.array([[1.0, 0, column], [0, 1, row], [0, 0, 1]])
        return float(plane_sweep_cpu.weighted_ncc(left, right, shifted, self._scale, self.window, part))

    def transfer_mask(self, mask: Mask, other: SweepPlane) -> Mask:
        """The cells (rows, columns) that cover the same pixels of the left image as ``mask`` does on ``other``."""
        to_other = np.linalg.solve(other.homographies[0], self.homographies[0])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(mask.astype(np.uint8), to_other, self.grid.size, flags=flags) > 0)

    def clear_masked(self, consistency: Image, mask: NDArray[np.uint8]) -> None:
        """Set ``consistency`` to 0, in place, where the left image is masked (H, W: not 0)."""
        plane_sweep_cpu.clear_masked(consistency, mask, self.homographies[0])

    @property
    def _scale(self) -> float:
        return float(0.5**self.level)


def warm_up() -> None:
    """Compile or load the kernels, which takes seconds at first: better before a camera starts."""
    image = np.zeros((16, 16), np.float32)
    plane = SweepPlane(PlaneGrid(-1.0, 1.0, 0.0, 0.5), 3, 0, np.stack([np.eye(3)] * 2))
    consistency = plane.consistency_map([[image], [image]], [[image], [image]], 1.0)
    plane.correlation_map([[image], [image]])
    plane.weighted_ncc([[image], [image]], consistency == 0)
    plane.clear_masked(consistency, np.zeros(image.shape, np.uint8))
    plane_sweep_cpu.weighted_sum(consistency, consistency[0])


def plane_at(homographies: tuple[Array, Array], grid: PlaneGrid, window: int, top: int = 0) -> SweepPlane:
    """The plane that both views see through ``homographies`` (3, 3), in images that begin at row ``top``."""
    shift_matrix = np.array([[1.0, 0, 0], [0, 1, -top], [0, 0, 1]])
    cells = np.stack([shift_matrix @ H @ grid.to_metres for H in homographies])
    return SweepPlane(grid, window, pyramid_level(homographies[0], grid), cells)
