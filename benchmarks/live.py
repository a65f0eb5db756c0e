"""Whether a live survey keeps up: two 1280 × 960 streams at 10 frames/s with two vehicles in view most of the time.

python benchmarks/live.py [--groups 6]

First the processor time of each pair of frames, at full speed; then the survey itself at the frame rate of the cameras,
which on a busy computer drops frames that an idle one would not.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import av
import cv2
import numpy as np
import yaml
from common import MPH, head, machine, rms, row
from numpy.typing import NDArray

from paceline.detection.background_model import RunningMedianBackground
from paceline.detection.finder import DetectedVehicle, VehicleFinder
from paceline.detection.lane_paths import lane_paths_of
from paceline.documents.loading import Clip, load_clip
from paceline.documents.rig_yaml import rig_yaml
from paceline.recordings.live_stereo import LiveStereo, RawPair, undistort_pair
from paceline.simulation.stereo.clip import Scene, Vehicle, World, render
from paceline.simulation.stereo.scenery import StaticBackground
from paceline.speed.configuration import BackgroundSettings, SpeedConfiguration
from paceline.speed.results import Measurement
from paceline.survey.live import survey

RATE = 10.0  # frames/s
FRAMES, GAP = 34, 10  # of a group of two vehicles, and without any behind it
BACKGROUND_S = 8.0  # duration of the empty road before the first vehicle
NOISE = 1.0  # grey levels


@dataclass(frozen=True, eq=False)
class RenderedStreams:
    """Pictures (H, W) of both views, and in which of them two vehicles are in view."""

    views: tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]
    busy: list[bool]
    speeds: list[float]  # m/s, of the vehicles


def scene(k: int) -> Scene:
    """The k-th group: an approaching vehicle and a receding one."""
    approaching = Vehicle("v0", 15.0 + k % 4, start_distance=66.0, lane=-1.85, texture_seed=20 + k, relief=0.03)
    receding = Vehicle(
        "v1", 12.0 + k % 3, start_distance=22.0, lane=1.85, texture_seed=60 + k, relief=0.03, receding=True
    )
    return Scene(
        seed=5,
        vehicles=(approaching, receding),
        image_size=(1280, 960),
        focal=2300.0,
        camera_height=3.0,
        tilt=0.03,
        road_direction=0.015,
        road_depth=40.0,
        noise_sigma=NOISE,
        rate=RATE,
        frames=FRAMES,
    )


def render_streams(groups: int) -> RenderedStreams:
    """An empty road, then group after group of vehicles."""
    world, rng = World(scene(0)), np.random.default_rng(3)
    stills = [StaticBackground(world.scene, world.road, world.scene.seed).draw(view) for view in world.views]
    views: tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]] = [], []
    busy: list[bool] = []

    def empty(frames: int) -> None:
        for still, pictures in zip(stills, views, strict=True):
            noise = rng.normal(0, NOISE, (frames, *still.shape)).astype(np.float32)
            pictures.extend(np.clip(still + n, 0, 255).astype(np.uint8) for n in noise)
        busy.extend([False] * frames)

    empty(int((BACKGROUND_S + 1) * RATE))
    speeds = []
    for k in range(groups):
        rendered = render(scene(k))
        for pictures, more in zip(views, (rendered.left, rendered.right), strict=True):
            pictures.extend(more)
        visible = [
            {row["vehicle"] for row in rendered.truth if row["frame"] == j and row["inside"]} for j in range(FRAMES)
        ]
        busy.extend(len(vehicles) == 2 for vehicles in visible)
        speeds += [v.speed for v in scene(k).vehicles]
        empty(GAP)
    return RenderedStreams(views, busy, speeds)


def write(streams: RenderedStreams, folder: Path) -> Clip:
    """Writes the streams as two H.264 videos, as of network cameras, with a rig.yaml whose slight distortion takes as
    long to remove as a strong one."""
    world = World(scene(0))
    cameras = [replace(camera, distortion=np.array([1e-7, 0, 0, 0])) for camera in world.rig.cameras]
    (folder / "rig.yaml").write_text(rig_yaml(replace(world.rig, left=cameras[0], right=cameras[1])))
    for name, pictures in zip(("left", "right"), streams.views, strict=True):
        with av.open(folder / f"{name}.mp4", "w") as container:
            stream = container.add_stream("libx264", rate=int(RATE), options={"crf": "16", "preset": "veryfast"})
            stream.width, stream.height, stream.pix_fmt = 1280, 960, "yuv420p"
            for picture in pictures:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "gray").reformat(format="yuv420p")))
            container.mux(stream.encode())
    document = {**world.clip, "left": "left.mp4", "right": "right.mp4", "rate": None, "vehicles": None}
    (folder / "clip.yaml").write_text(yaml.safe_dump({k: v for k, v in document.items() if v is not None}))
    return load_clip(folder / "clip.yaml")


def processor_times(streams: RenderedStreams, clip: Clip) -> list[float]:
    """Processor seconds for each pair: undistortion and detection."""
    empty = [pictures[0].astype(np.float32) for pictures in streams.views]
    finder = VehicleFinder(lane_paths_of(clip), RunningMedianBackground((empty[0], empty[1])))
    previous, seconds = None, []
    for k, (left, right) in enumerate(zip(*streams.views, strict=True)):
        pair, start_time = RawPair(k, k / RATE, left, right, 0.0), time.process_time()
        finder.finished_tracks(undistort_pair(pair, clip.rig, previous, finder.rows))
        seconds.append(time.process_time() - start_time)
        previous = pair
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description="Whether a live survey keeps up with two cameras.")
    parser.add_argument("--groups", type=int, default=6, help="pairs of vehicles that pass")
    args = parser.parse_args()
    cv2.setNumThreads(1)  # as the command does
    streams = render_streams(args.groups)
    with tempfile.TemporaryDirectory() as folder:
        clip = write(streams, Path(folder))
        seconds, busy = np.array(processor_times(streams, clip)), np.array(streams.busy)
        print(head("pairs of frames", "number", "median, ms", "95 %, ms", "most, ms"))
        for name, chosen in (("two vehicles in view", busy), ("none", ~busy)):
            ms = 1000 * seconds[chosen]
            print(row(name, len(ms), *(f"{np.percentile(ms, p):.0f}" for p in (50, 95, 100))), flush=True)
        results: list[Measurement | None] = []

        def on_result(detected: DetectedVehicle, measurement: Measurement | None, reason: str) -> None:
            results.append(measurement)

        views = LiveStereo(clip)
        cpu_s, start_time = time.process_time(), time.monotonic()
        dropped_before_ready: list[int] = []
        configuration = SpeedConfiguration(background=BackgroundSettings(seconds=BACKGROUND_S))
        survey(clip, views, configuration, on_result, lambda paths: dropped_before_ready.append(views.dropped))
        cpu_s, elapsed = time.process_time() - cpu_s, time.monotonic() - start_time
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
    measured = [m for m in results if m is not None and m.verdict == "measured"]
    errors = [min((m.speed - v for v in streams.speeds), key=abs) / MPH for m in measured]
    pairs = len(streams.busy)
    print(
        f"\nAs streams: {pairs} pairs in {elapsed:.0f} s, {views.dropped} dropped, {dropped_before_ready[0]} of them "
        f"while the background was estimated; {cpu_s / pairs * 1000:.0f} ms of processor time for each, "
        f"decoding included, and {children.ru_utime + children.ru_stime:.0f} s in all for the measuring process.\n"
        f"{len(results)} of {len(streams.speeds)} vehicles detected, {len(measured)} measured, "
        f"{rms(errors):.2f} mph rms.\n\n{machine()}"
    )


if __name__ == "__main__":
    main()
