"""Rendered clips with their pictures in memory, and the particle filter alone on them, frame by frame."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from common import MPH, Array, Rows, guessed, read_truth, rows_of

from paceline import load_clip, open_recording
from paceline.cameras import StereoRig
from paceline.documents.loading import Clip, PathDocument
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.estimate import Estimate
from paceline.speed.filter.tracker import Tracker
from paceline.speed.geometry.path_reconstruction import path_from_document
from paceline.speed.geometry.paths import Path
from zhu2012.reproductions import clip_folder

BEYOND = 30.0  # m by which the true way is carried on straight at both ends


@dataclass(frozen=True, eq=False)
class Loaded:
    clip: Clip
    truth: Rows
    frames: list[StereoFrame]

    def true(self, vehicle: str, frames: list[int], name: str = "speed_mps") -> Array:
        rows = rows_of(self.truth, vehicle)
        return np.array([rows[k][name] for k in frames])

    def with_guess(self, factor: float) -> Loaded:
        """The first guess of every vehicle's speed ``factor`` times the true one."""
        return replace(self, clip=guessed(self.clip, factor, self.truth))

    def without_noise(self) -> Loaded:
        """As if the operator had drawn without error: the true way as path, the true outline."""
        paths, vehicles = {}, []
        for v in self.clip.vehicles:
            rows = rows_of(self.truth, v.id)
            positions = np.array([rows[k]["position"] for k in sorted(rows)])
            ends = [
                end + BEYOND * (end - inner) / np.linalg.norm(end - inner)
                for end, inner in ((positions[0], positions[1]), (positions[-1], positions[-2]))
            ]
            drawn = self.clip.paths[v.path or ""]
            points = np.array([ends[0], *positions, ends[1]])
            name = f"true way of {v.id}"
            paths[name] = replace(drawn, name=name, left=None, right=None, lateral_offset=0.0, points=points)
            outline = {side: np.array(rows[v.frame][side]) for side in ("left", "right")}
            vehicles.append(replace(v, path=name, **outline))
        return replace(self, clip=replace(self.clip, paths=paths, vehicles=vehicles))


@lru_cache(maxsize=2)
def loaded(scene: str) -> Loaded:
    """A clip of ``items.clip_folder``."""
    folder = clip_folder(scene)
    clip = load_clip(folder / "clip.yaml")
    return Loaded(clip, read_truth(folder), list(open_recording(clip).frames()))


def as_printed(**settings: Any) -> SpeedConfiguration:
    """[Zhu]'s filter: nothing but the dynamics model proposes, and the drawn path is a hard constraint."""
    return SpeedConfiguration(guided=False, exact_path=True, refine=False, **settings)


@lru_cache(maxsize=8)
def _way(drawn: PathDocument, rig: StereoRig) -> Path:
    """The path as reconstructed, which takes longer than a run of the filter."""
    return path_from_document(drawn, rig)


def filtered(view: Loaded, configuration: SpeedConfiguration, index: int = 0) -> tuple[list[Estimate], list[float]]:
    """The filter's estimates of a vehicle of the clip, and the processor time of every update, ms."""
    vehicle, rig = view.clip.vehicles[index], view.clip.rig
    drawn = view.clip.paths.get(vehicle.path or "")
    path = None if drawn is None or configuration.motion == "free" else _way(drawn, rig)
    tracker = Tracker(rig, vehicle, path, 0.0 if drawn is None else drawn.lateral_offset, configuration)
    estimates, milliseconds = [], []
    for frame in view.frames[vehicle.frame :]:
        start_time = time.process_time()
        estimate = tracker.update(frame)
        milliseconds.append(1e3 * (time.process_time() - start_time))
        estimates.append(estimate)
        if estimate.status != "tracking":
            break
    return estimates, milliseconds


def last_speed(estimates: list[Estimate]) -> tuple[float, bool]:
    """The last speed that was tracked, mph, and whether the track held to the end of the view."""
    tracked = [e for e in estimates if e.status == "tracking"]
    return tracked[-1].speed / MPH, estimates[-1].status != "lost"
