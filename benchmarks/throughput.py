"""How many times faster than real time recordings of sparse and of dense traffic are measured, and what that takes.

python benchmarks/throughput.py [--flows 60 300 1200] [--sizes 640x480 1280x960] [--seconds 60] [--overlay all]

No vehicle is outlined in the clips: all are found first. Beside Paceline's own method stand its quickest baseline,
which finds the vehicles in the same way, and decoding both videos without doing anything else.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import av
import numpy as np
from common import head, machine, row

from paceline.simulation.camera_errors import StereoErrors
from paceline.simulation.stereo.clip import Scene, Vehicle, render, write
from paceline.simulation.stereo.scene import make_rig

RATE = 10.0  # frames/s
CRF = 20  # quality of the videos
FOCAL_WIDTHS = 1.8  # focal length in widths of the picture
LANE_M = 1.85  # from the road's axis to the middle of either lane
FAR_M, NEAR_M = 66.0, 22.0  # at which vehicles come into view, in the lane that approaches and in the other one
LAST_PASSAGE_S = 3.5  # before the recording ends, so that the last vehicle is seen for long enough
METHODS = ("paceline", "lucas-kanade")
DISTORTION = np.array([1e-7, 0.0, 0.0, 0.0])  # so slight that pictures need none, it takes as long to remove as any


@dataclass(frozen=True)
class Cost:
    """What a run took: elapsed and processor ``seconds``, and its greatest memory in MB."""

    seconds: float
    processor_s: float
    peak_mb: float = float("nan")


def scene(flow: float, size: tuple[int, int], seconds: float) -> Scene:
    """``flow`` vehicles per hour, in turn in two lanes, for so many ``seconds`` and with pictures of this ``size``."""
    rng = np.random.default_rng(7)
    interval = 3600.0 / flow
    entries = np.arange(interval / 2, seconds - LAST_PASSAGE_S, interval) if interval < 2 * seconds else []
    if not len(entries):
        entries = [seconds / 2]
    vehicles = []
    for k, entry in enumerate(entries):
        speed, receding = float(rng.uniform(13.0, 16.0)), k % 2 == 1
        start = NEAR_M - speed * float(entry) if receding else FAR_M + speed * float(entry)
        lane = LANE_M if receding else -LANE_M
        vehicles.append(Vehicle(f"t{k}", speed, 0.0, start, receding, lane=lane, texture_seed=20 + k, relief=0.03))
    return Scene(
        seed=5,
        vehicles=tuple(vehicles),
        image_size=size,
        focal=FOCAL_WIDTHS * size[0],
        camera_height=3.0,
        tilt=0.03,
        road_direction=0.015,
        road_depth=40.0,
        noise_sigma=1.0,
        rate=RATE,
        frames=round(seconds * RATE),
        errors=StereoErrors(crf=CRF),
    )


def record(of: Scene, folder: Path) -> Path:
    """Writes the clip of a scene, two videos whose cameras have lenses with distortion; the path of its clip.yaml."""
    rig, rendered = make_rig(of), render(of)
    left, right = (replace(camera, distortion=DISTORTION) for camera in rig.cameras)
    clip = {**rendered.clip, "vehicles": []}
    return write(replace(rendered, rig=replace(rig, left=left, right=right), clip=clip), folder)


def run(clip: Path, out: Path, options: list[str]) -> Cost:
    """The cost of ``paceline speed`` in a process of its own, with all processes that it starts."""
    command = [sys.executable, "-m", "paceline", "speed", str(clip), "-o", str(out), "--quiet", *options]
    start_time = time.perf_counter()
    process = subprocess.Popen(command)
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) not in (0, 1):
        raise SystemExit(f"{' '.join(command)}: exit status {os.waitstatus_to_exitcode(status)}")
    processor_s = usage.ru_utime + usage.ru_stime
    return Cost(time.perf_counter() - start_time, processor_s, usage.ru_maxrss * 1024 / 1e6)


def decode(clip: Path) -> Cost:
    """The cost of decoding both videos."""
    start_time, processor_s = time.perf_counter(), time.process_time()
    for side in ("left", "right"):
        with av.open(str(clip.parent / f"{side}.mp4")) as container:
            for _ in container.decode(video=0):
                pass
    return Cost(time.perf_counter() - start_time, time.process_time() - processor_s)


def cells(cost: Cost, seconds: float, vehicles: int) -> list[str]:
    return [
        f"{seconds / cost.seconds:.2f}",
        f"{cost.processor_s / seconds:.2f}",
        f"{cost.processor_s / vehicles:.2f}" if vehicles else "",
        "" if np.isnan(cost.peak_mb) else f"{cost.peak_mb:.0f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="How many times faster than real time recordings are measured.")
    parser.add_argument("--flows", type=float, nargs="+", default=[60, 300, 1200], help="vehicles per hour")
    parser.add_argument("--sizes", nargs="+", default=["640x480", "1280x960"], help="of the pictures, px")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of each recording")
    parser.add_argument("--overlay", default="all", help="as of paceline speed")
    args = parser.parse_args()
    columns = "× real time", "processor s per recorded s", "per vehicle", "peak memory, MB"
    print(head("flow, vehicles/h", "picture", "program", *columns, "vehicles", "measured"), flush=True)
    for size in args.sizes:
        for flow in args.flows:
            with tempfile.TemporaryDirectory() as folder:
                width, height = (int(n) for n in size.split("x"))
                clip = record(scene(flow, (width, height), args.seconds), Path(folder))
                for method in METHODS:
                    out = Path(folder) / method
                    cost = run(clip, out, ["--method", method, "--overlay", args.overlay])
                    vehicles = json.loads((out / "summary.json").read_text())["vehicles"]
                    measured = sum(v["verdict"] == "measured" for v in vehicles)
                    figures = cells(cost, args.seconds, len(vehicles))
                    print(row(f"{flow:g}", size, method, *figures, len(vehicles), measured), flush=True)
                print(row(f"{flow:g}", size, "decoding", *cells(decode(clip), args.seconds, 0), "", ""), flush=True)
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
