"""Array types by element type, and pictures in 8 bits; shapes and units are documented where the arrays are used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


def to_8_bit(image: NDArray[np.floating]) -> Bytes:
    """Grey levels ``image`` (…), 0–255, rounded to 8 bits."""
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)
