"""Time and memory of the whole command, with report and video, on clips of different length.

python benchmarks/command.py [--frames 12 48] [--seed 0]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import head, machine, row

from paceline.simulation.stereo.clip import Scene, Vehicle, render, write

WAY = 35.0  # m, however many frames


def scene(frames: int, seed: int) -> Scene:
    """A vehicle that approaches from 70 to 35 m, 1024 × 768 pixels."""
    rate = 5.0 * frames / 12
    vehicle = Vehicle("v0", WAY * rate / (frames - 1), start_distance=70.0, texture_seed=seed, relief=0.03)
    return Scene(seed, (vehicle,), frames=frames, rate=rate, camera_height=2.6, tilt=0.025, road_depth=50.0)


def run(clip: Path) -> tuple[float, float]:
    """Seconds and peak memory (MB) of ``paceline speed`` in a process of its own."""
    start_time = time.perf_counter()
    command = [sys.executable, "-m", "paceline", "speed", str(clip), "-o", str(clip.parent / "out"), "--quiet"]
    process = subprocess.Popen(command)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)}: exit status {os.waitstatus_to_exitcode(status)}")
    return time.perf_counter() - start_time, usage.ru_maxrss * 1024 / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description="Time and memory of the whole command.")
    parser.add_argument("--frames", type=int, nargs="+", default=[12, 48], help="lengths of the clips")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print(head("frames", "first run, s", "second run, s", "peak memory, MB"), flush=True)
    for frames in args.frames:
        with tempfile.TemporaryDirectory() as folder:
            clip = write(render(scene(frames, args.seed)), folder)
            first, second = run(clip), run(clip)
        print(row(frames, f"{first[0]:.1f}", f"{second[0]:.1f}", f"{second[1]:.0f}"), flush=True)
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
