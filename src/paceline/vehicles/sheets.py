"""Cards at many stations laid out at once: one above the other on sheets, so that one call works on many of them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.vehicles.ways import Grid, level_of

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Indices = NDArray[np.int64]

CARDS = 24  # on a sheet: about what a processor's cache holds


class Sheets:
    """The cards on a ``grid`` that N stations' ``homographies`` of both views see, each with a margin of
    half a ``window`` that mirrors what is inside, so that local means over the window do not mix neighbours.

    ``batches`` are the stations in groups of which each fits on a sheet.
    """

    def __init__(self, homographies: list[tuple[Array, Array]], grid: Grid, window: int) -> None:
        columns, rows = grid.size
        self._inside = slice(window // 2, window // 2 + rows), slice(window // 2, window // 2 + columns)
        x, y = np.meshgrid(_mirrored(columns, window // 2), _mirrored(rows, window // 2))
        cells = np.stack([x, y, np.ones_like(x)], axis=-1).astype(float)
        self._shape = x.shape
        self._levels = np.array([level_of(left, grid) for left, _ in homographies], int)
        self._maps = np.empty((len(homographies), 2, 2, *x.shape), np.float32)
        of_level = [np.flatnonzero(self._levels == level) for level in np.unique(self._levels)]
        self.batches = [
            batch for stations in of_level for batch in np.array_split(stations, range(CARDS, len(stations), CARDS))
        ]
        for k, views in enumerate(homographies):
            for view, H in enumerate(views):
                p = cells @ (H @ grid.to_metres).T
                self._maps[k, view] = np.moveaxis(p[..., :2] / p[..., 2:] / 2.0 ** self._levels[k], -1, 0)

    def lay_out(self, levels: list[Image], view: int, batch: Indices, flags: int = cv2.INTER_LINEAR) -> Image:
        """A sheet (n (rows + margins), columns + margins): what the pyramid ``levels`` of a ``view`` (0 left, 1 right)
        show on the cards of a ``batch``."""
        x, y = np.moveaxis(self._maps[batch, view], 1, 0).reshape(2, -1, self._shape[1])
        image = levels[self._levels[batch[0]]]
        return np.asarray(cv2.remap(image, x, y, flags, borderMode=cv2.BORDER_REPLICATE))

    def cards(self, sheet: Image) -> Image:
        """The cards (n, rows, columns) of a sheet, without their margins."""
        return sheet.reshape(-1, *self._shape)[:, *self._inside]


def _mirrored(count: int, margin: int) -> Indices:
    """0 to ``count`` − 1, and before and behind it ``margin`` more that run back."""
    inside = np.arange(count)
    return np.concatenate([inside[:margin][::-1], inside, inside[count - margin :][::-1]])
