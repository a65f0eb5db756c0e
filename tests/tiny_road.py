"""A small rig beside a straight road, for tests that find vehicles."""

from __future__ import annotations

from dataclasses import replace

from paceline.simulation.stereo.clip import Scene, Vehicle

TWO = (
    Vehicle("v0", 16.0, start_distance=64.0, lane=-1.85, texture_seed=6, relief=0.03),
    Vehicle("v1", 13.0, start_distance=26.0, lane=1.85, texture_seed=9, relief=0.03, receding=True),
)


def scene(*vehicles: Vehicle, **more: object) -> Scene:
    """The road with these vehicles, or with one that comes nearer."""
    vehicles = vehicles or (Vehicle("v0", 16.0, start_distance=60.0, lane=-1.85, texture_seed=6, relief=0.03),)
    plain = Scene(
        seed=5,
        vehicles=vehicles,
        image_size=(640, 480),
        focal=1300.0,
        camera_height=2.6,
        tilt=0.025,
        road_direction=0.015,
        road_depth=40.0,
        noise_sigma=0.8,
        frames=9,
    )
    return replace(plain, **more)  # type: ignore[arg-type]
