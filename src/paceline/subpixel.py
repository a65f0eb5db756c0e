"""The position of a peak between samples, by a parabola."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def parabola_peak(before: float, centre: float, behind: float, reach: float = 0.5) -> float:
    """Offset of the maximum of the parabola through three values, one step apart, in steps from the middle one.

    At most ``reach``; where the parabola has no maximum, ``reach`` towards the greater neighbour.
    """
    bend = min(before - 2.0 * centre + behind, -1e-9)
    return min(max(0.5 * (before - behind) / bend, -reach), reach)


def parabola_peak_at(values: NDArray[np.floating], best: int) -> float:
    """Offset of the maximum from ``best``, the greatest of ``values`` (N,), at most half a step; 0 at either end."""
    if not 0 < best < len(values) - 1:
        return 0.0
    return parabola_peak(*map(float, values[best - 1 : best + 2]))
