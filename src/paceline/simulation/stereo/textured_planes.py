"""Textured rectangles in space, drawn with exact homographies and area sampling.

Every rectangle is warped onto a grid of ``oversampling``² sub-pixels; all together are blurred as by a lens and
averaged over each pixel's area. Pixel centres have integer coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.cameras import PosedCamera
from paceline.simulation.textures import TEXTURE_LEVELS, Texture


@dataclass(frozen=True, eq=False)
class TexturedPlane:
    """A texture on a rectangle in space: its top-left ``corner`` (3,) and its two edges (3,), in metres."""

    texture: Texture
    corner: Array
    across: Array
    down: Array

    def corners(self) -> Array:
        a, b = self.across, self.down
        return np.asarray(self.corner + np.array([0 * a, a, a + b, b]))


def draw_planes(
    cards: list[TexturedPlane], view: PosedCamera, blur: float, oversampling: int, within: slice | None = None
) -> tuple[Image, slice, slice] | None:
    """The ``cards``, far ones first, over nothing: premultiplied grey and coverage (h, w, 2) and the rows and columns
    of the image that they fill, of the rows ``within`` alone; None where all are out of sight."""
    cards = [c for c in cards if (view.depth(c.corners()) > 0.5).all()]
    if not cards:
        return None
    outline = view.project(np.array([c.corners() for c in cards])).reshape(-1, 2)
    pad = 2 + int(np.ceil(4 * blur))
    width, height = view.camera.image_size
    x0, y0 = np.maximum(np.floor(outline.min(0)).astype(int) - pad, 0)
    x1, y1 = np.minimum(np.ceil(outline.max(0)).astype(int) + pad + 1, (width, height))
    top, bottom = (y0, y1) if within is None else (max(y0, within.start), min(y1, within.stop))
    if x0 >= x1 or top >= bottom:
        return None
    y0, y1 = max(y0, top - pad), min(y1, bottom + pad)  # from where the blur reaches the rows
    n = oversampling
    canvas = np.zeros(((y1 - y0) * n, (x1 - x0) * n, 2), np.float32)
    # The centre of sub-pixel p lies at (p + 0.5) / n - 0.5 + x0 in the image.
    to_canvas = np.array([[n, 0, n * (0.5 - x0) - 0.5], [0, n, n * (0.5 - y0) - 0.5], [0, 0, 1.0]])
    for card in cards:
        _draw_plane(canvas, card, to_canvas @ view.camera.K, view)
    if blur > 0:
        canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), blur * n, borderType=cv2.BORDER_REPLICATE), np.float32)
    small = cv2.resize(canvas, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
    return np.asarray(small[top - y0 : bottom - y0], np.float32), slice(top, bottom), slice(x0, x1)


def _draw_plane(canvas: Image, card: TexturedPlane, projection: Array, view: PosedCamera) -> None:
    """Composite one card onto the sub-pixel ``canvas`` (h, w, 2) in place."""
    edges = np.column_stack([card.across, card.down, card.corner])
    H = projection @ (view.R @ edges + np.outer(view.t, [0, 0, 1]))  # unit square -> canvas
    quad = H @ np.array([[0, 1, 1, 0], [0, 0, 1, 1], [1, 1, 1, 1.0]])
    quad = quad[:2] / quad[2]
    x0, y0 = np.maximum(np.floor(quad.min(1)).astype(int) - 1, 0)
    x1, y1 = np.minimum(np.ceil(quad.max(1)).astype(int) + 2, canvas.shape[1::-1])
    if x0 >= x1 or y0 >= y1:
        return
    sides = np.linalg.norm(np.roll(quad, -1, axis=1) - quad, axis=0)  # top, right, bottom, left in sub-pixels
    rows, columns = card.texture.value.shape
    texels = max(columns / max(sides[0], sides[2]), rows / max(sides[1], sides[3]))  # per sub-pixel
    level = card.texture.pyramid[int(np.clip(round(np.log2(texels)), 0, TEXTURE_LEVELS - 1))]
    rows, columns = level.shape[:2]
    unit = np.array([[1 / columns, 0, 0.5 / columns], [0, 1 / rows, 0.5 / rows], [0, 0, 1]])
    shift = np.array([[1, 0, -x0], [0, 1, -y0], [0, 0, 1.0]])
    patch = cv2.warpPerspective(level, shift @ H @ unit, (int(x1 - x0), int(y1 - y0)), flags=cv2.INTER_LINEAR)
    under = canvas[y0:y1, x0:x1]
    under *= 1 - patch[..., 1:]
    under += patch


def composite(image: Image, drawn: tuple[Image, slice, slice] | None) -> None:
    """Lay what `draw_planes` returned over the grey levels ``image`` (H, W), in place."""
    if drawn is not None:
        patch, rows, columns = drawn
        image[rows, columns] *= 1 - patch[..., 1]
        image[rows, columns] += patch[..., 0]
