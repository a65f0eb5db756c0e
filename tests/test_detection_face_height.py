"""The top of a face is cut off where it adds nothing to what is known of the motion."""

from __future__ import annotations

import numpy as np
import pytest
from selection import slow_after
from synthetic_detections import BOTTOM, PLANE_GRID, TOP, X, face_with, texture_up_to

from paceline.detection.face_height import HEIGHT_STEP_M, MIN_OUTLINE_HEIGHT_M, select_height
from paceline.detection.planar_face import PlanarFace

RIM = 0.1  # m: 2 px of the farthest view


def clear(lower: PlanarFace) -> bool:
    return True


@pytest.mark.parametrize("seed", slow_after(1, [1, 2, 3]))
@pytest.mark.parametrize("height", [0.75, 0.95])
def test_untextured_top_of_a_face_is_cut_off(height: float, seed: int) -> None:
    face = face_with(texture_up_to(height, seed), seed)
    lower = select_height(face, face.aligned, clear)
    assert lower.x == face.x and lower.y[0] == BOTTOM and lower.aligned is face.aligned
    # what is flat goes but for a step, and the rim of an outline, which is not used; of what has texture no more
    # than a third, even if every row said as much
    assert BOTTOM + (height - BOTTOM) * 2 / 3 - HEIGHT_STEP_M < lower.y[1] < height + HEIGHT_STEP_M + RIM


@pytest.mark.parametrize("seed", slow_after(1, [1, 2, 3]))
def test_most_of_a_textured_face_is_kept(seed: int) -> None:
    face = face_with(texture_up_to(PLANE_GRID.top, seed), seed)
    assert select_height(face, face.aligned, clear).y[1] > BOTTOM + (TOP - BOTTOM) * 2 / 3 - HEIGHT_STEP_M


def test_a_low_face_and_one_with_few_frames_are_unchanged() -> None:
    face = face_with(texture_up_to(0.75, 1), 1)
    assert select_height(face, face.aligned[:3], clear) is face
    low = PlanarFace(X, (BOTTOM, BOTTOM + MIN_OUTLINE_HEIGHT_M), face.aligned, 0.9)
    assert select_height(low, low.aligned, clear) is low


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_face_without_any_texture_stays_as_it_is(seed: int) -> None:
    """Noise would choose its height."""
    flat = face_with(texture_up_to(0.0, seed), seed)
    assert select_height(flat, flat.aligned, clear) is flat


def test_no_outline_is_taken_that_is_not_clear() -> None:
    face = face_with(texture_up_to(0.75, 1), 1)
    assert select_height(face, face.aligned, lambda lower: False) is face
    assert select_height(face, face.aligned, lambda lower: lower.y[1] > 1.1).y[1] == pytest.approx(TOP - HEIGHT_STEP_M)


def test_face_with_images_of_nan_is_kept() -> None:
    face = face_with(texture_up_to(0.75, 1), 1)
    for a in face.aligned:
        a.detection.crops[0][:] = np.nan
    assert select_height(face, face.aligned, clear) is face
