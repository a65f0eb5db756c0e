"""Closed-loop scenes by name: the trials of [NIST], demanding manoeuvres of a convoy, and a long drive of all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from paceline.simulation.closed_loop.long_drive import draw_long_drive

SceneGenerator = Callable[[np.random.Generator], dict[str, Any]]

CRUISE_SPEED_MPS = 9.7  # m/s: 35 km/h
MOTORWAY_SPEED_MPS = 27.8  # m/s: 100 km/h
LANE_CHANGE_SHIFT_M = 3.5  # the width of a lane
NO_TRAFFIC: dict[str, Any] = {"traffic": False}


def _constant_speed(duration: float, speed: float = CRUISE_SPEED_MPS, **more: Any) -> dict[str, Any]:
    return {
        "duration": duration,
        "road": {"radius": 110.0},
        "lead": {"speed": [[0.0, speed]]},
        **more,
    }


def cruise(rng: np.random.Generator) -> dict[str, Any]:
    return _constant_speed(60.0, throttle="manual")


def turns(rng: np.random.Generator) -> dict[str, Any]:
    return _constant_speed(60.0, throttle="manual") | {"road": {"radius": float(rng.uniform(45, 70))}}


def intersection(rng: np.random.Generator) -> dict[str, Any]:
    side = float(rng.choice([-1.0, 1.0]))
    kind = str(rng.choice(["van", "saloon", "lorry", "bus"]))
    # as tight as the camera's 46° of view can follow from the gap at which the whole rear is in view
    radius = float(rng.uniform(22.0, 26.0) if kind in ("van", "saloon") else rng.uniform(29.0, 33.0))
    arc = radius * np.pi / 2
    return {
        "duration": 40.0,
        "throttle": "manual",
        "road": {"pieces": [[100.0, 0.0], [arc, side * radius], [120.0, 0.0]], "blend": 8.0},
        "lead": {"kind": kind, "speed": [[0.0, 7.0]], "max_lateral_acceleration": 0.8},
        "appearance": NO_TRAFFIC,
    }


def stops(rng: np.random.Generator) -> dict[str, Any]:
    return _constant_speed(60.0) | {
        "lead": {
            "speed": [
                [0, CRUISE_SPEED_MPS],
                [12, CRUISE_SPEED_MPS],
                [17, 0],
                [24, 0],
                [29, 8],
                [38, 8],
                [41, 0],
                [48, 0],
                [53, 6],
            ]
        },
        "requirements": {"rms_gap_error": 1.5},
    }


def shadows(rng: np.random.Generator) -> dict[str, Any]:
    return _constant_speed(
        60.0, throttle="manual", appearance={"shadows": 1.6, "ambient": float(rng.uniform(0.26, 0.34))}
    )


def weaving(rng: np.random.Generator) -> dict[str, Any]:
    period = float(rng.uniform(7.0, 10.0))
    weave = {"start": 3.0, "stop": 55.0, "amplitude": float(rng.uniform(0.9, 1.3)), "period": period}
    return _constant_speed(60.0, throttle="manual") | {"lead": {"speed": [[0.0, CRUISE_SPEED_MPS]], "weaves": [weave]}}


def parallel_edges(rng: np.random.Generator) -> dict[str, Any]:
    return _constant_speed(60.0, throttle="manual", appearance={"parallel_share": 1.0, "object_density": 1.6})


def brakes_hard(rng: np.random.Generator) -> dict[str, Any]:
    start, braking = float(rng.uniform(8, 12)), float(rng.uniform(5.5, 6.5))
    return _constant_speed(25.0) | {
        "lead": {"speed": [[0, CRUISE_SPEED_MPS], [start, CRUISE_SPEED_MPS], [start + CRUISE_SPEED_MPS / braking, 0.0]]}
    }


def accelerates_away(rng: np.random.Generator) -> dict[str, Any]:
    speeds = [[0, 4.0], [6, 4.0], [6 + 8.0 / 3, 12.0], [16, 12.0], [20, 7.0]]
    return _constant_speed(30.0) | {
        "lead": {"speed": speeds, "max_acceleration": 3.0},
        "requirements": {"max_gap": 26.0},
    }


def changes_lane(rng: np.random.Generator) -> dict[str, Any]:
    changes = [
        {"at": 8.0, "duration": float(rng.uniform(3.5, 5.0)), "shift": -LANE_CHANGE_SHIFT_M},
        {"at": 20.0, "duration": float(rng.uniform(3.5, 5.0)), "shift": LANE_CHANGE_SHIFT_M},
    ]
    return _constant_speed(32.0, appearance=NO_TRAFFIC) | {
        "lead": {"speed": [[0.0, CRUISE_SPEED_MPS]], "lane_changes": changes}
    }


def cuts_in(rng: np.random.Generator) -> dict[str, Any]:
    duration = float(rng.uniform(3.5, 5.0))
    return _constant_speed(35.0, appearance=NO_TRAFFIC, headway=1.3, road={"radius": 250.0}) | {
        "cut_ins": [{"at": 8.0, "until": 8.0 + 2.5 + duration, "kind": str(rng.choice(["van", "saloon"]))}],
        "requirements": {"lost": None, "tracked": 0.2, "ends": "either"},
    }


def occluded(rng: np.random.Generator) -> dict[str, Any]:
    kinds = rng.permutation(["vehicle", "post"])
    crossings = [{"at": start, "duration": 1.0, "kind": str(k)} for start, k in zip((8.0, 17.0), kinds, strict=True)]
    return _constant_speed(27.0) | {"crossings": crossings}


def stop_and_go(rng: np.random.Generator) -> dict[str, Any]:
    speeds, t = [[0.0, 5.0]], 4.0
    while t < 52.0:
        top, hold = float(rng.uniform(2.5, 7.0)), float(rng.uniform(2.0, 4.0))
        brake = top / float(rng.uniform(1.5, 3.0))
        speeds += [[t, top], [t + hold, top], [t + hold + brake, 0.0], [t + hold + brake + 2.5, 0.0]]
        t += hold + brake + 2.5 + top / 1.5
    return _constant_speed(60.0) | {"lead": {"speed": [*speeds, [t, 4.0]]}, "requirements": {"rms_gap_error": 1.5}}


def lost(rng: np.random.Generator) -> dict[str, Any]:
    vanishing_time = float(rng.uniform(9.0, 12.0))
    return _constant_speed(25.0) | {
        "lead": {"speed": [[0.0, CRUISE_SPEED_MPS]], "vanishes": vanishing_time},
        "requirements": {"lost": None, "stops_within": 25.0, "ends": "standing"},
    }


def motorway(rng: np.random.Generator) -> dict[str, Any]:
    change = {"at": 20.0, "duration": 5.0, "shift": -LANE_CHANGE_SHIFT_M}
    back = {"at": 38.0, "duration": 5.0, "shift": LANE_CHANGE_SHIFT_M}
    speeds = [[0, MOTORWAY_SPEED_MPS], [28, MOTORWAY_SPEED_MPS], [32, 22.0], [36, 22.0], [42, MOTORWAY_SPEED_MPS]]
    return {
        "camera": "hd",
        "duration": 60.0,
        "road": {"radius": 450.0},
        "lead": {"speed": speeds, "lane_changes": [change, back]},
        "appearance": NO_TRAFFIC,
        "requirements": {"rms_path_error": 0.6, "max_path_error": 1.8},
    }


NAMED_SCENES: dict[str, SceneGenerator] = {
    "cruise-35": cruise,
    "turns": turns,
    "intersection": intersection,
    "stops": stops,
    "shadows": shadows,
    "weaving": weaving,
    "parallel-edges": parallel_edges,
    "brakes-hard": brakes_hard,
    "accelerates-away": accelerates_away,
    "changes-lane": changes_lane,
    "cuts-in": cuts_in,
    "occluded": occluded,
    "stop-and-go": stop_and_go,
    "lost": lost,
    "long": draw_long_drive,
    "motorway-100": motorway,
}
