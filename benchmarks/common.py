"""What the benchmarks share: scenes, truth, processes, Markdown tables and the machine they ran on."""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from paceline import UnusableInput, load_clip, open_recording
from paceline.documents.loading import Clip
from paceline.simulation.random_scenes.drawn import random_scene
from paceline.simulation.raytraced import stereo_clip
from paceline.simulation.raytraced.scene_yaml import SpeedScene
from paceline.simulation.stereo.clip import Scene, render, write
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.methods import DEFAULT_METHOD, measure
from paceline.speed.results import Measurement
from paceline.units import SpeedUnit

Array = NDArray[np.float64]
Rows = list[dict[str, Any]]
Item = TypeVar("Item")
Done = TypeVar("Done")
Made = TypeVar("Made")

MPH = SpeedUnit.MPH.mps
SHARED = Path(__file__).parents[2] / "shared" / "data"  # recordings that are not part of the project
PLAIN_RIG: dict[str, Any] = {"image_size": (1024, 768), "focal": 2200.0, "baseline": 0.5}
PLAIN_TRIES = 300
SEED_STEP, SEED_TRIES = 10_000, 50  # to the seed that is tried next where no scene suits, and how often


def plain_scene(seed: int, **overrides: Any) -> Scene:
    """A clip without complications, filmed with a 2200-pixel lens and cameras half a metre apart.

    One vehicle at constant speed drives at least 20 m within 15–80 m in 10–14 frames at 5–12.5 frames/s; its relief is
    at most 3 cm; no glare, no pole. Rate, speed, direction, curve, noise, light and dropped frames vary with ``seed``.
    """
    vehicle = {"acceleration": 0.0, "glare": False, "relief": 0.03 * (seed % 2)}
    for k in range(PLAIN_TRIES):
        scene = random_scene(PLAIN_TRIES * seed + k, vehicle=vehicle, occluder=False, **PLAIN_RIG, **overrides)
        near, far = distances(scene)
        if 10 <= scene.frames <= 14 and scene.rate <= 12.5 and far - near >= 20 and near >= 15 and far <= 80:
            return scene
    raise ValueError(f"no plain scene for seed {seed}")


def distances(scene: Scene) -> tuple[float, float]:
    """The nearest and the farthest point of the vehicle's way, metres along the road."""
    vehicle, duration = scene.vehicles[0], (scene.frames - 1) / scene.rate
    travel = vehicle.speed * duration + vehicle.acceleration * duration**2 / 2
    ends = vehicle.start_distance, vehicle.start_distance + (travel if vehicle.receding else -travel)
    return min(ends), max(ends)


@contextmanager
def rendered(scene: Scene, states_cameras: bool = True) -> Iterator[tuple[Clip, Rows]]:
    """The clip of ``scene`` and its truth, in files that vanish afterwards, and that say of ideal cameras that they are
    if ``states_cameras``."""
    with tempfile.TemporaryDirectory() as folder:
        result = render(scene)
        yield load_clip(write(result, folder, states_cameras)), result.truth


@contextmanager
def raytraced(
    scene: SpeedScene, folder: Path | None = None, states_cameras: bool = True
) -> Iterator[tuple[Clip, Rows]]:
    """The clip of a ray-traced ``scene`` and its truth, in a ``folder`` that keeps them, or in files that vanish; as
    `rendered`."""
    with tempfile.TemporaryDirectory() as temporary:
        path = stereo_clip.write(scene, folder or Path(temporary) / "clip", states_cameras=states_cameras)
        yield load_clip(path), read_truth(path.parent)


def guessed(clip: Clip, factor: float, truth: Rows) -> Clip:
    """``clip`` with every vehicle's first guess ``factor`` times its true speed."""
    guesses = {v.id: factor * rows_of(truth, v.id)[v.frame]["speed_mps"] for v in clip.vehicles}
    return replace(clip, vehicles=[replace(v, speed=guesses[v.id]) for v in clip.vehicles])


def measured(clip: Clip, **settings: Any) -> list[Measurement]:
    """The measurements of ``clip`` with the default configuration but for ``settings``."""
    return measure(clip, open_recording(clip), DEFAULT_METHOD, SpeedConfiguration(**settings)).measurements


def why_not(error: Exception) -> str:
    """Why there is no measurement, for a row of a table: an error of the clip, or a fault of the program."""
    if isinstance(error, UnusableInput):
        return f"unusable: {str(error).partition(': ')[2]}"
    return f"fault of the program: {type(error).__name__}: {error}"


def suitable(make: Callable[[int], Made], seed: int) -> Made:
    """A scene of ``seed``, or of the first one after it that suits."""
    for k in range(SEED_TRIES):
        try:
            return make(seed + k * SEED_STEP)
        except (ValueError, UnusableInput):
            continue
    raise ValueError(f"no scene for seed {seed}")


def rows_of(truth: Rows, vehicle: str) -> dict[int, dict[str, Any]]:
    """The rows of one vehicle, by frame."""
    return {row["frame"]: row for row in truth if row["vehicle"] == vehicle}


def true_speeds(truth: Rows, m: Measurement) -> Array:
    """True speeds (N,) m/s at the frames of a track, NaN at those of which no truth is stated."""
    rows = rows_of(truth, m.vehicle)
    return np.array([rows[k]["speed_mps"] if k in rows else np.nan for k in m.track.frame.tolist()])


def true_mean(truth: Rows, m: Measurement) -> float:
    """The true mean speed over time, m/s, from the first to the last frame that was tracked and has a truth."""
    rows = rows_of(truth, m.vehicle)
    tracked = [k for k, s in zip(m.track.frame.tolist(), m.track.status, strict=True) if s == "tracking" and k in rows]
    t, v = (np.array([rows[k][name] for k in tracked]) for name in ("time_s", "speed_mps"))
    return float(np.trapezoid(v, t) / (t[-1] - t[0]))


def read_truth(folder: Path) -> Rows:
    rows: Rows = json.loads((folder / "truth.json").read_text())
    return rows


def share_out(work: Callable[[Item], Done], items: Sequence[Item], workers: int) -> Iterator[Done]:
    """``work`` done on ``items`` by processes of one thread each; the results come in the items' order."""
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"  # read by the processes as they start
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(work, items)


def rms(values: Sequence[float] | Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def row(*cells: object) -> str:
    """One row of a Markdown table."""
    return "| " + " | ".join(str(c) for c in cells) + " |"


def head(*cells: str) -> str:
    """The first two rows of a Markdown table."""
    return row(*cells) + "\n" + row(*("---" for _ in cells))


def machine() -> str:
    """The processor and the versions that matter, in one line."""
    names = ("numba", "numpy", "opencv-python-headless")
    packages = ", ".join(f"{n} {metadata.version(n)}" for n in names)
    return f"Machine: {_processor()}, {os.cpu_count()} cores, Python {platform.python_version()}, {packages}"


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
