"""Specular reflections: the same cars on the straight road of [Zhu], glossy as they are and with matte paint.

python benchmarks/specular.py -o suites/specular
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
from common import head, machine, measured, read_truth, rms, row, true_mean

from paceline import load_clip
from paceline.simulation.raytraced import named_scenes, stereo_clip
from paceline.simulation.raytraced.meshes import Material
from paceline.simulation.raytraced.scene_yaml import SpeedScene
from paceline.simulation.raytraced.vehicles import build
from paceline.units import SpeedUnit

KMH = SpeedUnit.KMH.mps


def scene_of(car: int, samples: int) -> SpeedScene:
    """`straight-55` with another car, its outline and road drawn without the operator's noise."""
    scene = named_scenes.speed_scene("straight-55")
    assert scene is not None
    vehicle = scene.vehicles[0].model_copy(update={"seed": car})
    exact = scene.operator_noise.model_copy(update={"corner": 0.0, "line": 0.0})
    return scene.model_copy(update={"vehicles": [vehicle], "samples": samples, "operator_noise": exact})


@contextmanager
def painted(matte: bool) -> Iterator[None]:
    """All that vehicles are made of as it is, or with nothing that mirrors."""
    as_it_is = build.vehicle_materials

    def dull(rng: np.random.Generator, fleet: bool = False) -> dict[str, Material]:
        return {name: replace(m, kind="matte") for name, m in as_it_is(rng, fleet).items()}

    with mock.patch.object(build, "vehicle_materials", dull if matte else as_it_is):
        yield


def main() -> None:
    parser = argparse.ArgumentParser(description="The effect of specular reflections on the speed.")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for the clips; those there are kept")
    parser.add_argument("--samples", type=int, default=48, help="rays per pixel")
    parser.add_argument("--cars", type=int, nargs="+", default=[3, 11, 12, 13, 14, 15, 16], help="their seeds")
    args = parser.parse_args()
    print(head("car", "face", "true, km/h", "error", "95 % ±", "verdict"), flush=True)
    errors: dict[str, list[float]] = {"glossy": [], "matte": []}
    for car in args.cars:
        for face, found in errors.items():
            with painted(face == "matte"):
                path = stereo_clip.write(scene_of(car, args.samples), args.out / f"{car}-{face}")
            m = measured(load_clip(path))[0]
            true = true_mean(read_truth(path.parent), m)
            error, half = (m.speed - true) / KMH, (m.speed_hi - m.speed_lo) / 2 / KMH
            if m.verdict == "measured":
                found.append(error)
            numbers = f"{true / KMH:.2f}", f"{error:+.3f}", f"{half:.3f}"
            print(row(car, face, *numbers, m.reason or m.verdict), flush=True)
    print("\n" + head("face", "measured", "mean error", "RMS", "worst"))
    for face, found in errors.items():
        e = np.array(found)
        if len(e):
            print(row(face, len(e), f"{e.mean():+.3f}", f"{rms(e):.3f}", f"{np.abs(e).max():.3f}"))
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
