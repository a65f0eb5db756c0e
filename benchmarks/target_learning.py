"""Models learned from a box: how far their range is off, whether that is stated, and whether they are followed.

python benchmarks/target_learning.py [--n 20] [--seed 900] [--preset nist|hd|full_hd] [--frames 60] [--boxes 3]
    [--click 1.0] [--every 1000] [--folders suites/follow ../shared/data/chase_dark] [--workers 2]

Each vehicle is learned from boxes around its rear plane whose sides err by --click px (standard deviation), from its
first picture and, with --every K, from every K-th one; the width given is the true one. It is then followed from the
place that learning gives. Vehicles are drawn (`simulate chase`); with --folders they are those of recordings with a
truth.json, such as `paceline simulate suite --kind follow` makes.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import Array, head, machine, rms, row, share_out
from follow import OFF_PLACE, OFF_RANGE, SEEN
from numpy.typing import NDArray

from paceline.cameras import Camera
from paceline.documents.loading import load_camera
from paceline.errors import UnusableInput
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.tracker import FollowTracker
from paceline.simulation.chase.clip import CHASE_PRESETS, render_frames
from paceline.simulation.random_scenes.drawn import random_chase
from paceline.targets.learning import learn_target
from paceline.targets.line_model import Target
from paceline.targets.stated_width import StatedWidth
from paceline.units import COVERAGE_95

RATE_HZ = 15.0  # of recordings in folders
DARK_PAINT = 65.0  # grey level of paint below which a drawn vehicle is dark
WHOLE = 0.97  # of the rear plane must be visible in the picture from which it is learned


@dataclass(frozen=True, eq=False)
class TrueFrame:
    """A picture and its truth: the rear plane's ``position`` (3,) m, its ``corners`` (4, 2) px from the top left
    clockwise, and the part of it that is visible."""

    image: NDArray[np.uint8]
    position: Array
    corners: Array
    visible: float


@dataclass(frozen=True, eq=False)
class ChaseRecording:
    """Frames of one vehicle ahead of a ``camera``."""

    name: str
    group: str
    camera: Camera
    frames: list[TrueFrame]

    def width(self, k: int) -> float:
        """The true width of the rear plane in frame ``k``, m."""
        frame = self.frames[k]
        width_px = np.linalg.norm(frame.corners[1] - frame.corners[0])
        return float(width_px * frame.position[2] / self.camera.K[0, 0])


@dataclass
class Outcome:
    """What came of one box: the model's errors, and, frame by frame, the range's."""

    name: str
    group: str
    frame: int
    refused: str = ""
    width_px: float = np.nan  # the true one
    error: float = np.nan  # of the nominal range, relative
    std: float = np.nan  # of the nominal range, relative, as the model's tolerance states it
    frames: int = 0  # in which the vehicle can be seen
    wrong: int = 0  # called tracking, and far off
    range_errors: list[float] = field(default_factory=list)  # relative, of tracked frames
    covered: list[bool] = field(default_factory=list)  # by the stated 95 % interval


def drawn_recording(seed: int, preset: str, frames: int) -> ChaseRecording:
    scene = random_chase(seed, preset, frames=frames)
    group = "dark" if scene.paint < DARK_PAINT else "bright"
    rendered = [TrueFrame(image, t.position, t.corners, t.visible) for image, t in render_frames(scene)]
    return ChaseRecording(f"{seed}, {scene.kind}, {scene.paint:.0f}", group, scene.camera, rendered)


def recording_in(folder: Path, frames: int) -> ChaseRecording:
    """The recording with a truth.json in a ``folder``."""
    truth: Any = json.loads((folder / "truth.json").read_text())
    rows = (truth if isinstance(truth, list) else truth["truth"])[:frames]
    pictures = sorted((folder / "frames").iterdir())
    found = []
    for picture, values in zip(pictures, rows, strict=False):
        image = np.asarray(cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE), np.uint8)
        position, corners = np.array(values["position"]), np.array(values["corners"])
        found.append(TrueFrame(image, position, corners, values.get("visible", 1.0)))
    return ChaseRecording(folder.name, "ray-traced", load_camera(folder / "camera.yaml"), found)


def outcomes(item: int | Path, args: argparse.Namespace) -> list[Outcome]:
    """All boxes of one vehicle."""
    cv2.setNumThreads(1)
    if isinstance(item, Path):
        recording, seed = recording_in(item, args.frames), [*item.name.encode()]
    else:
        recording, seed = drawn_recording(item, args.preset, args.frames), [item]
    done = []
    for k in range(0, len(recording.frames), args.every):
        if recording.frames[k].visible >= WHOLE:
            rngs = [np.random.default_rng([*seed, k, b, 61]) for b in range(args.boxes)]
            done += [learned_and_followed(recording, k, rng, args.click) for rng in rngs]
    return done


def learned_and_followed(recording: ChaseRecording, k: int, rng: np.random.Generator, click_px: float) -> Outcome:
    """The outcome of a box in frame ``k`` whose sides err by ``click_px`` (standard deviation)."""
    outcome, first = Outcome(recording.name, recording.group, k), recording.frames[k]
    top_left, top_right, bottom_right, bottom_left = first.corners
    sides = [top_left + bottom_left, top_left + top_right, top_right + bottom_right, bottom_left + bottom_right]
    true_box = 0.5 * np.array([sides[0][0], sides[1][1], sides[2][0], sides[3][1]])
    x0, y0, x1, y1 = (true_box + rng.normal(0, click_px, 4)).tolist()
    outcome.width_px = float(true_box[2] - true_box[0])
    picture = first.image.astype(np.float32)
    try:
        learned = learn_target(picture, (x0, y0, x1, y1), StatedWidth(recording.width(k)), recording.camera, "vehicle")
    except UnusableInput as error:
        outcome.refused = str(error)
        return outcome
    t = learned.target
    model = Target(t.name, t.nominal_range, t.corners, t.segments, t.tolerance)
    outcome.error = t.nominal_range / float(first.position[2]) - 1.0
    outcome.std = t.tolerance / float(model.size[0])
    tracker = FollowTracker(recording.camera, model, (*learned.center, 1.0), FollowConfiguration())
    for n, frame in enumerate(recording.frames[k:]):
        add_frame(outcome, frame, tracker.update(frame.image, n / RATE_HZ, n), recording.width(k + n))
    return outcome


def add_frame(outcome: Outcome, frame: TrueFrame, estimate: Any, width: float) -> None:
    if frame.visible < SEEN:
        return
    outcome.frames += 1
    if estimate.status != "tracking":
        return
    far = float(frame.position[2])
    error = float(estimate.position[2]) - far
    beside = np.linalg.norm(estimate.position / estimate.position[2] * far - frame.position)
    outcome.wrong += bool(abs(error) > OFF_RANGE * far or beside > OFF_PLACE * width)
    outcome.range_errors.append(error / far)
    outcome.covered.append(bool(abs(error) <= COVERAGE_95 * estimate.position_std[2]))


COLUMNS = (
    "boxes",
    "refused",
    "model: range RMS, %",
    "worst, %",
    "beyond 2 %",
    "z",
    "covered",
    "frames",
    "tracked",
    "wrong",
    "range RMS, %",
    "range covered",
)


def cells(group: Sequence[Outcome]) -> list[str]:
    learned = [o for o in group if not o.refused]
    counts = [str(len(group)), str(len(group) - len(learned))]
    if not learned:
        return [*counts, *["–"] * (len(COLUMNS) - 2)]
    error, std = (np.array([getattr(o, name) for o in learned]) for name in ("error", "std"))
    ranges = np.array([e for o in learned for e in o.range_errors])
    covered = [c for o in learned for c in o.covered]
    frames = sum(o.frames for o in learned)
    return [
        *counts,
        f"{100 * rms(error):.2f}",
        f"{100 * float(np.abs(error).max()):.1f}",
        str(int((np.abs(error) > 0.02).sum())),
        f"{rms(error / std):.2f}",
        f"{np.mean(np.abs(error) <= COVERAGE_95 * std):.0%}",
        str(frames),
        f"{len(ranges) / max(frames, 1):.1%}",
        str(sum(o.wrong for o in learned)),
        f"{100 * rms(ranges):.2f}" if len(ranges) else "–",
        f"{np.mean(covered):.0%}" if covered else "–",
    ]


GROUPS: dict[str, Callable[[Outcome], bool]] = {
    "all": lambda o: True,
    "bright": lambda o: o.group == "bright",
    "dark": lambda o: o.group == "dark",
    "under 50 px wide": lambda o: o.width_px < 50,
    "wider": lambda o: o.width_px >= 50,
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Models learned from a box, and following by them.")
    parser.add_argument("--n", type=int, default=20, help="number of drawn vehicles")
    parser.add_argument("--seed", type=int, default=900, help="seed of the first one")
    parser.add_argument("--preset", choices=sorted(CHASE_PRESETS), default="nist", help="camera, speeds and distances")
    parser.add_argument("--frames", type=int, default=60, help="frames of each recording")
    parser.add_argument("--boxes", type=int, default=3, help="boxes drawn in each picture")
    parser.add_argument("--click", type=float, default=1.0, help="standard deviation of a box's sides, px")
    parser.add_argument("--every", type=int, default=1000, help="frames between two pictures that are learned from")
    parser.add_argument("--folders", type=Path, nargs="*", help="recordings, or folders of recordings, instead")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    start_time = time.perf_counter()
    items: list[int | Path] = list(range(args.seed, args.seed + args.n))
    if args.folders:
        items = [file.parent for folder in args.folders for file in sorted(folder.rglob("truth.json"))]
    print(head("vehicle", *COLUMNS), flush=True)
    done: list[Outcome] = []
    for found in share_out(partial(outcomes, args=args), items, args.workers):
        done += found
        if found:
            print(row(found[0].name, *cells(found)), flush=True)
    print("\n" + head("vehicles", *COLUMNS))
    for name, belongs in GROUPS.items():
        if group := [o for o in done if belongs(o)]:
            print(row(name, *cells(group)))
    print(f"\n{time.perf_counter() - start_time:.0f} s with {args.workers} processes.\n\n{machine()}")


if __name__ == "__main__":
    main()
