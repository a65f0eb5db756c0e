"""Where between samples a peak lies."""

from __future__ import annotations


def vertex(before: float, at: float, behind: float, reach: float = 0.5) -> float:
    """Where the parabola through three values, one step apart, has its top, in steps from the middle one, at most
    ``reach``; where it has none, as far as that towards the greater neighbour."""
    bend = min(before - 2.0 * at + behind, -1e-9)
    return min(max(0.5 * (before - behind) / bend, -reach), reach)
