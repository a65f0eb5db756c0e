"""Ray-traced scenes by name: those of the papers, and similar ones.

[Zhu] V: images of 1024×768 (rendered) or 1280×960 (recorded) at 5 frames/s, cameras half a metre apart; on the
circle 36 mph at 22.5°/s, a radius of 41 m. [NIST] 3: 256×242 at 15 Hz, 5 to 15 m behind, to 35 km/h, moderate turns and
shadows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from paceline.simulation.raytraced.scene_yaml import FollowScene, SpeedScene
from paceline.units import MPS_PER_MPH

RECORDED_RIG: dict[str, Any] = {"image_size": [1280, 960], "focal": 2600.0}
SPARSE_SCENERY: dict[str, Any] = {"trees": 0.3, "poles": 0.3, "buildings": 0.2}


def _make_rig(
    along: float, right: float, target: float, lateral: float, height: float = 2.0, **more: Any
) -> dict[str, Any]:
    eye = {"along": along, "right": right, "height": height}
    return {"eye": eye, "target": {"along": target, "right": lateral, "height": 0.8}, **more}


def _oncoming_vehicle(start: float, mph: float, **more: Any) -> dict[str, Any]:
    return {"id": "v0", "start": start, "speed": mph * MPS_PER_MPH, "lane": 0, "oncoming": True, **more}


def _speed_document(frames: int, rig: dict[str, Any], vehicles: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    return {
        "kind": "speed",
        "frames": frames,
        "rate": 5,
        "rig": rig,
        "vehicles": vehicles,
        "scenery": SPARSE_SCENERY,
        **more,
    }


def _lane_change_document(mph: float, duration: float, frames: int, start: float) -> dict[str, Any]:
    change = {"start": 0.6, "duration": duration, "shift": 3.7}
    road = {"length": 260.0, "lane_width": 3.7, "lanes": 3}
    car = _oncoming_vehicle(start, mph, seed=23, lane_change=change)
    return _speed_document(frames, _make_rig(10.0, 8.0, 60.0, 0.0, height=3.5, **RECORDED_RIG), [car], road=road)


_SPEED_SCENES: dict[str, tuple[str, Callable[[], dict[str, Any]]]] = {
    "straight-55": (
        "straight road, 55 mph, 1024×768",
        lambda: _speed_document(12, _make_rig(10.0, -6.5, 65.0, -1.5), [_oncoming_vehicle(95.0, 55, seed=3)]),
    ),
    "circle-36": (
        "circle of 41 m, 36 mph, 1024×768",
        lambda: _speed_document(
            13,
            _make_rig(50.0, 5.6, 82.0, -1.0, height=4.0, focal=1500.0),
            [_oncoming_vehicle(101.0, 36, seed=4)],
            road={"kind": "circle", "radius": -40.98, "length": 180.0},
        ),
    ),
    "recorded-straight-36": (
        "straight road that falls and leans, 36 mph, 1280×960",
        lambda: _speed_document(
            14,
            _make_rig(10.0, -7.0, 60.0, -1.5, height=2.6, **RECORDED_RIG),
            [_oncoming_vehicle(85.0, 36, seed=5, kind="estate")],
            road={"grade": -0.03, "bank": 0.03},
        ),
    ),
    "neil-28": (
        "winding road, 28 mph, 1280×960",
        lambda: _speed_document(
            16,
            _make_rig(30.0, -6.0, 70.0, -1.5, height=2.6, **RECORDED_RIG | {"focal": 2000.0}),
            [_oncoming_vehicle(92.0, 28, seed=6)],
            road={"kind": "clothoid", "radius": 90.0, "length": 180.0},
        ),
    ),
    "oh315": (
        "two vehicles on a highway, 50 and 57 mph, 1280×960",
        lambda: _speed_document(
            12,
            _make_rig(10.0, -9.0, 75.0, 0.0, height=6.0, **RECORDED_RIG),
            [
                _oncoming_vehicle(105.0, 50, seed=7, initial_speed=55 * MPS_PER_MPH),
                _oncoming_vehicle(112.0, 57, seed=8, kind="van", initial_speed=55 * MPS_PER_MPH)
                | {"id": "v1", "lane": 2},
            ],
            road={"lanes": 3, "length": 300.0, "lane_width": 3.7},
        ),
    ),
    "lane-change-35": ("lane change at 35 mph in 5 s, 1280×960", lambda: _lane_change_document(35, 5.0, 22, 96.0)),
    "lane-change-30": ("lane change at 30 mph in 3 s, 1280×960", lambda: _lane_change_document(30, 3.0, 20, 88.0)),
}


def _follow_document(light: dict[str, Any], scenery: dict[str, Any], radius: float) -> dict[str, Any]:
    road = {"kind": "winding", "radius": radius, "length": 600.0}
    return {"kind": "follow", "frames": 450, "rate": 15, "road": road, "light": light, "scenery": scenery}


_FOLLOW_SCENES: dict[str, tuple[str, Callable[[], dict[str, Any]]]] = {
    "nist-turns": (
        "moderate turns, thin cloud, 256×242 at 15 Hz",
        lambda: _follow_document({"clouds": 0.6}, SPARSE_SCENERY, 60.0),
    ),
    "nist-shadows-moderate": (
        "trees' shadows under a hazy sun, 256×242 at 15 Hz",
        lambda: _follow_document(
            {"clouds": 0.35, "azimuth": 1.4}, {"trees": 0.7, "poles": 0.5, "buildings": 0.2}, 110.0
        ),
    ),
    "nist-shadows-strong": (
        "dense shadows under a clear sky, 256×242 at 15 Hz",
        lambda: _follow_document(
            {"clouds": 0.0, "azimuth": 1.2, "elevation": 0.9}, {"trees": 1.0, "poles": 0.8}, 110.0
        ),
    ),
}


def list_scenes() -> list[tuple[str, str, str]]:
    """Kind, name and description of every scene."""
    return [
        (kind, name, text)
        for kind, all_ in (("speed", _SPEED_SCENES), ("follow", _FOLLOW_SCENES))
        for name, (text, _) in all_.items()
    ]


def speed_scene(name: str) -> SpeedScene | None:
    """The speed scene of that name, if there is one."""
    return SpeedScene.model_validate(_SPEED_SCENES[name][1]()) if name in _SPEED_SCENES else None


def follow_scene(name: str) -> FollowScene | None:
    """The follow scene of that name, if there is one."""
    return FollowScene.model_validate(_FOLLOW_SCENES[name][1]()) if name in _FOLLOW_SCENES else None
