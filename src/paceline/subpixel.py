"""Where between samples a peak lies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def vertex(before: float, at: float, behind: float, reach: float = 0.5) -> float:
    """Where the parabola through three values, one step apart, has its top, in steps from the middle one, at most
    ``reach``; where it has none, as far as that towards the greater neighbour."""
    bend = min(before - 2.0 * at + behind, -1e-9)
    return min(max(0.5 * (before - behind) / bend, -reach), reach)


def vertex_at(values: NDArray[np.floating], best: int) -> float:
    """The same about the ``best`` of ``values`` (N,), within half a step of it; 0 at either end."""
    if not 0 < best < len(values) - 1:
        return 0.0
    return vertex(*map(float, values[best - 1 : best + 2]))
