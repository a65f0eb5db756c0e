"""The simulated kinds of vehicles: names, shares in traffic, and the smallest gap at which each is followed."""

from __future__ import annotations

from typing import Literal, get_args

# Modelled in relief and rendered by ray tracing. What a seed makes depends on the order.
RaytracedKind = Literal["saloon", "estate", "van", "lorry", "bus", "motorcycle"]
RAYTRACED_KINDS: tuple[str, ...] = get_args(RaytracedKind)
TRAFFIC_SHARES = (0.36, 0.2, 0.16, 0.12, 0.08, 0.08)  # of each kind in traffic
# The nearest that each is followed, m.
MIN_RAYTRACED_GAP_M = {"saloon": 5.0, "estate": 5.0, "van": 5.5, "lorry": 7.5, "bus": 7.5, "motorcycle": 5.0}

# Drawn on faces for a camera behind them. What a seed makes depends on the order.
RasterizedKind = Literal["van", "saloon", "lorry", "bus"]
RASTERIZED_KINDS: tuple[str, ...] = get_args(RasterizedKind)
MIN_RASTERIZED_GAP_M = {
    "van": 5.0,
    "saloon": 5.0,
    "lorry": 7.5,
    "bus": 7.0,
}  # m: the whole rear is in view from there on
