"""The recordings beside the project, ../shared/data, against their references.

python benchmarks/recordings.py [--data FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from common import MPH, SHARED, head, machine, measured, read_truth, row, true_mean

from paceline import load_clip
from paceline.speed.results import Measurement

CROSSING = {"minivan": 14.9, "estate": 14.1, "red": 14.9, "hatchback": 12.1}  # m/s, of its README; good to about 2 %


def main() -> None:
    parser = argparse.ArgumentParser(description="Recordings against their references.")
    parser.add_argument("--data", type=Path, default=SHARED, help="folder of recordings")
    folder = parser.parse_args().data
    print(head("recording", "vehicle", "reference, mph", "measured, mph", "error, mph", "error, %", "model", "verdict"))
    absent = []
    for name in ("kitti_crossing", "rendered/straight", "rendered/curve"):
        if not (folder / name / "clip.yaml").exists():
            absent.append(name)
            continue
        for m in measured(load_clip(folder / name / "clip.yaml")):
            real = name == "kitti_crossing"
            print(_row(name, m, CROSSING[m.vehicle] if real else true_mean(read_truth(folder / name), m)), flush=True)
    print()
    for name in absent:
        print(f"{folder / name} is absent: skipped.")
    print(machine())


def _row(name: str, m: Measurement, reference: float) -> str:
    half, error = (m.speed_hi - m.speed_lo) / 2, m.speed - reference
    return row(
        name,
        m.vehicle,
        f"{reference / MPH:.2f}",
        f"{m.speed / MPH:.2f} ± {half / MPH:.2f}",
        f"{error / MPH:+.2f}",
        f"{100 * error / reference:+.2f}",
        m.model,
        f"{m.verdict}: {m.reason}" if m.reason else m.verdict,
    )


if __name__ == "__main__":
    main()
