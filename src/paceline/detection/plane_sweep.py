"""Cards at the stations of ways, as both pictures of a pair show them: how much each place of one counts."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Mask
from paceline.detection import plane_sweep_cpu
from paceline.detection.lane_paths import Grid, level_of

Views = list[list[Image]]  # the pyramids of the left and of the right picture


@dataclass(frozen=True, eq=False)
class Card:
    """The cells of a ``grid``, which the left and the right picture show at the pixels ``cells`` (2, 3, 3) makes of
    (column, row, 1); pictures are compared over ``window`` cells, at the ``level`` of their pyramids."""

    grid: Grid
    window: int
    level: int
    cells: Array

    def counts(self, views: Views, scene: Views, least: float, enough: float = 0.0) -> Image:
        """How much each place (rows, columns) counts, 0 to 1: where the views have a contrast of ``least``
        grey levels and agree with each other, and neither with its picture of the empty ``scene``. Nothing does where
        less than ``enough`` m² of it would."""
        found = np.empty(self.grid.size[::-1], np.float32)
        left, right, left_before, right_before = (levels[self.level] for levels in (*views, *scene))
        cells = enough / self.grid.cell**2
        plane_sweep_cpu.count(
            left, right, left_before, right_before, self.cells, self._scale, self.window, least, cells, found
        )
        return found

    def correlation(self, views: Views) -> tuple[Image, Image]:
        """The correlation of both pictures, and the contrast of the left one, at each place (rows, columns)."""
        found, contrast = np.empty((2, *self.grid.size[::-1]), np.float32)
        left, right = (levels[self.level] for levels in views)
        plane_sweep_cpu.correlate(left, right, self.cells, self._scale, self.window, found, contrast)
        return found, contrast

    def sharpness(self, views: Views, piece: Mask) -> float:
        """How well the pictures of a ``piece`` (rows, columns) fit each other, the more of it the more contrast both
        have: places with little of it agree at any distance."""
        if not piece.any():
            return -1.0
        left, right = (levels[self.level] for levels in views)
        rows, columns = (np.flatnonzero(piece.any(axis)) for axis in (1, 0))
        row, column = (max(int(places[0]) - self.window, 0) for places in (rows, columns))
        part = np.ascontiguousarray(piece[row : rows[-1] + 1 + self.window, column : columns[-1] + 1 + self.window])
        cells = self.cells @ np.array([[1.0, 0, column], [0, 1, row], [0, 0, 1]])
        return float(plane_sweep_cpu.sharpness(left, right, cells, self._scale, self.window, part))

    def showing(self, piece: Mask, other: Card) -> Mask:
        """Where (rows, columns) the left picture shows what it shows in a ``piece`` of another card."""
        there = np.linalg.solve(other.cells[0], self.cells[0])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(piece.astype(np.uint8), there, self.grid.size, flags=flags) > 0)

    def hide(self, counts: Image, explained: NDArray[np.uint8]) -> None:
        """Count nothing, in place, where the left picture is ``explained`` (H, W: not 0)."""
        plane_sweep_cpu.hide(counts, explained, self.cells[0])

    @property
    def _scale(self) -> float:
        return float(0.5**self.level)


def warm_up() -> None:
    """Compile or load the kernels, which takes seconds at first: better before cameras are waited for."""
    picture = np.zeros((16, 16), np.float32)
    card = Card(Grid(-1.0, 1.0, 0.0, 0.5), 3, 0, np.stack([np.eye(3)] * 2))
    counts = card.counts([[picture], [picture]], [[picture], [picture]], 1.0)
    card.correlation([[picture], [picture]])
    card.sharpness([[picture], [picture]], counts == 0)
    card.hide(counts, np.zeros(picture.shape, np.uint8))
    plane_sweep_cpu.weighted(counts, counts[0])


def card_of(homographies: tuple[Array, Array], grid: Grid, window: int, top: int = 0) -> Card:
    """The card that both views see through ``homographies``, in pictures that begin at the row ``top``."""
    moved = np.array([[1.0, 0, 0], [0, 1, -top], [0, 0, 1]])
    cells = np.stack([moved @ H @ grid.to_metres for H in homographies])
    return Card(grid, window, level_of(homographies[0], grid), cells)
