"""Lanes found without clicking, against the exact roads of rendered clips.

python benchmarks/lanes.py CLIP…   (folders that `paceline simulate speed` or `simulate suite` wrote)
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from paceline.cameras import StereoRig
from paceline.documents.loading import load_clip_recording
from paceline.lanes.lane_proposals import Lane, propose_lanes
from paceline.lanes.road_detection import RoadNotFound, detect_road
from paceline.recordings.background import estimate_background
from paceline.recordings.stereo import open_recording
from paceline.simulation.raytraced.scene import PlacedStereoScene
from paceline.simulation.raytraced.scene_yaml import load_speed_scene
from paceline.speed.configuration import DEFAULTS
from paceline.units import COVERAGE_95

Array = NDArray[np.float64]

NEAREST, FARTHEST = 4.0, 80.0  # m of depth
SEEN = 15.0  # m of both of a lane's lines that have to be in both pictures
SAME = 1.0  # m that a lane's middle may lie beside the true one


def true_lanes(placed: PlacedStereoScene) -> list[Array]:
    """Centre lines (N, 3) in the left camera's frame of the lanes between painted lines that both pictures show."""
    s = np.arange(0.5, placed.road.length, 0.5)
    view, found = placed.views[0], []
    for a, b in zip(placed.road.markings, placed.road.markings[1:], strict=False):
        shown = np.ones(len(s), bool)
        for marking in (a, b):
            points = placed.road.line(marking, s[0], s[-1], 0.5)
            for camera in placed.views:
                depth, pixels = camera.to_camera(points)[:, 2], camera.project(points)
                inside = ((pixels > 2) & (pixels < np.array(camera.camera.image_size) - 3)).all(1)
                shown &= (depth > NEAREST) & (depth < FARTHEST) & inside
        if 0.5 * shown.sum() >= SEEN:
            found.append(view.to_camera(placed.road.line((a + b) / 2, s[0], s[-1], 0.5)))
    return found


def lateral_offsets(lane: Lane, truth: Array, rig: StereoRig) -> Array:
    """Distances (N,) of a proposed path from a true centre line where the path is drawn, up to 80 m ahead."""
    assert lane.path is not None
    points = lane.path.points[(lane.path.points[:, 2] > NEAREST) & (lane.path.points[:, 2] < FARTHEST)]
    drawn, pixels = rig.left.undistort_points(lane.left), rig.left.project(points)
    points = points[((pixels >= drawn.min(0)) & (pixels <= drawn.max(0))).all(1)]
    if not len(points):
        return np.array([np.inf])
    offset = points[:, None] - truth
    nearest = np.argmin((offset**2).sum(-1), axis=1).clip(1, len(truth) - 2)
    along = truth[nearest + 1] - truth[nearest - 1]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    miss = points - truth[nearest]
    return np.asarray(np.linalg.norm(miss - (miss * along).sum(1, keepdims=True) * along, axis=1))


def main(folders: list[Path]) -> None:
    found = false = total = inside = 0
    widths, middles = [], []
    print("clip              lanes  found  false  width error, m (± 95 %)            middle, m  CPU, s")
    for folder in folders:
        placed = PlacedStereoScene(load_speed_scene(folder / "scene.yaml"))
        truths, start = true_lanes(placed), time.process_time()
        clip = load_clip_recording(folder / "clip.yaml")
        try:
            background = estimate_background(open_recording(clip), DEFAULTS.background.frames)
            proposed, _ = propose_lanes(clip.rig, detect_road(clip.rig, background))
            lanes = [lane for lane in proposed if lane.path is not None]
        except RoadNotFound as reason:
            lanes = []
            print(f"{folder.name}: {reason}")
        seconds = time.process_time() - start
        met, errors, offsets = set(), [], []
        for lane in lanes:
            misses = [float(np.median(lateral_offsets(lane, truth, clip.rig))) for truth in truths]
            k = int(np.argmin(misses)) if misses else -1
            if k < 0 or misses[k] > SAME:
                false += 1
                continue
            met.add(k)
            error = lane.width - placed.road.shape.lane_width
            errors.append(f"{error:+.3f} (± {COVERAGE_95 * lane.width_std:.3f})")
            inside += abs(error) <= COVERAGE_95 * lane.width_std
            widths.append(error)
            middles.append(misses[k])
            offsets.append(misses[k])
        found, total = found + len(met), total + len(truths)
        print(
            f"{folder.name:17} {len(truths):5}  {len(met):5}  {len(lanes) - len(errors):5}  {'  '.join(errors):33}  "
            f"{' '.join(f'{m:.2f}' for m in offsets):9}  {seconds:.0f}"
        )
    if widths:
        rms = np.sqrt(np.mean(np.square(widths)))
        print(
            f"\n{found} of {total} lanes found, {false} false; width error rms {rms:.3f} m, "
            f"{inside} of {len(widths)} within their 95 % intervals;\n"
            f"middle off by {np.median(middles):.2f} m (median), {max(middles):.2f} m at most"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Lanes found in ray-traced scenes, against their truth.")
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="a clip of `paceline simulate speed`")
    main(parser.parse_args().folders)
