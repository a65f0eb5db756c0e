"""Scenes small enough to render in a test."""

from __future__ import annotations

from typing import Any

BARE = {"trees": 0.0, "poles": 0.0, "buildings": 0.0}


def tiny_speed(**changes: Any) -> dict[str, Any]:
    """A saloon that comes towards a small pair of cameras from 22 m away."""
    scene: dict[str, Any] = {
        "kind": "speed",
        "seed": 3,
        "frames": 3,
        "rate": 10,
        "samples": 2,
        "road": {"length": 80.0},
        "scenery": BARE,
        "vehicles": [{"id": "v0", "start": 36.0, "speed": 12.0, "oncoming": True, "seed": 2}],
        "rig": {
            "image_size": [192, 144],
            "focal": 430.0,
            "eye": {"along": 8.0, "right": -5.0, "height": 2.0},
            "target": {"along": 28.0, "right": -2.0, "height": 0.5},
        },
    }
    return scene | changes


def tiny_follow(**changes: Any) -> dict[str, Any]:
    """Two frames behind a van."""
    scene: dict[str, Any] = {
        "kind": "follow",
        "frames": 2,
        "rate": 15,
        "samples": 2,
        "road": {"kind": "winding", "radius": 100.0, "length": 80.0},
        "scenery": BARE,
        "chase": {"image_size": [128, 120], "focal": 150.0},
    }
    return scene | changes
