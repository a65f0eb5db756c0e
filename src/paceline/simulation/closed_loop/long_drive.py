"""A long drive of randomly drawn manoeuvres, one after another."""

from __future__ import annotations

from typing import Any

import numpy as np

DURATION_S = 1020.0  # 17 minutes, 15,300 frames


def draw_long_drive(rng: np.random.Generator) -> dict[str, Any]:
    """Cruising at many speeds, stops, hard braking, weaving, things that cross, bends and corners."""
    speeds: list[list[float]] = [[0.0, 8.0]]
    weaves: list[dict[str, float]] = []
    crossings: list[dict[str, Any]] = []
    t = 8.0
    while t < DURATION_S - 30:
        t += 0.5
        manoeuvre = str(rng.choice(["cruise", "slow", "stop", "hard", "weave", "crossing"]))
        top = float(rng.uniform(6.5, 9.7))
        if manoeuvre == "slow":
            top = float(rng.uniform(3.0, 5.0))
        speeds += [[t, speeds[-1][1]], [t + 4.0, top]]
        t += 4.0
        duration = float(rng.uniform(8.0, 16.0))
        if manoeuvre == "weave":
            amplitude, period = float(rng.uniform(0.6, 1.2)), float(rng.uniform(7.0, 11.0))
            weaves.append({"start": t, "stop": t + duration, "amplitude": amplitude, "period": period})
        if manoeuvre == "crossing":
            kind = str(rng.choice(["vehicle", "post"]))
            crossings.append({"at": t + 4.0, "duration": float(rng.uniform(0.6, 1.0)), "kind": kind})
        speeds.append([t + duration, top])
        t += duration
        if manoeuvre in ("stop", "hard"):
            braking = float(rng.uniform(4.5, 6.0) if manoeuvre == "hard" else rng.uniform(1.5, 3.0))
            wait = float(rng.uniform(2.0, 8.0))
            speeds += [[t + top / braking, 0.0], [t + top / braking + wait, 0.0]]
            t += top / braking + wait
    pieces: list[list[float]] = []
    distance = 0.0
    while distance < 10.0 * DURATION_S:
        block, distance = _draw_road_block(rng), distance + 400.0
        pieces += block
    return {
        "duration": DURATION_S,
        "road": {"pieces": pieces, "blend": 20.0},
        "lead": {"speed": speeds, "weaves": weaves, "max_lateral_acceleration": 1.2},
        "crossings": crossings,
        "requirements": {"rms_gap_error": 2.0},
    }


def _draw_road_block(rng: np.random.Generator) -> list[list[float]]:
    """About 400 m of straights and bends, with a corner now and then."""
    side = float(rng.choice([-1.0, 1.0]))
    pieces = [[float(rng.uniform(50, 120)), 0.0]]
    for _ in range(3):
        radius = float(rng.choice([-1.0, 1.0]) * rng.uniform(60, 200))
        pieces += [[float(rng.uniform(30, 70)), radius], [float(rng.uniform(20, 50)), 0.0]]
    if rng.random() < 0.35:
        radius = float(rng.uniform(28.0, 36.0))
        pieces += [[radius * 1.5, side * radius], [40.0, 0.0]]
    return pieces
