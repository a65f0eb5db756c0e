"""Following rendered vehicles: frames lost, range and lateral error, coverage and time, beside other trackers.

python benchmarks/follow.py [--n 20] [--seed 500] [--preset nist|hd|full_hd] [--frames 450] [--workers 2] [--long]
    [--readout 0.02] [--vibration 0.003]

Every tracker sees the same frames in one run, rendered beforehand. OpenCV's trackers are started on the exact box of
the rear plane and their range comes from the box's width and the vehicle's true one. ViSP's have Paceline's model and
start; they are compiled where libvisp-dev is installed. --long instead follows one vehicle for 15,300 frames. --readout
and --vibration render the same clips with a rolling shutter and a camera that vibrates; no tracker is told.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from common import Array, head, machine, rms, row, share_out
from numpy.typing import NDArray
from visp.edge_tracker import EdgeTracker, compiled

from paceline.follow.configuration import FollowConfiguration
from paceline.follow.tracker import FollowTracker
from paceline.recordings.odometry import Pose
from paceline.simulation.chase.clip import (
    CHASE_PRESETS,
    ChaseScene,
    ChaseTruth,
    render_frames,
    start_document,
    target_document,
)
from paceline.simulation.random_scenes.drawn import random_chase
from paceline.targets.line_model import Target
from paceline.units import COVERAGE_95

Image = NDArray[np.uint8]

LONG = 15_300  # frames: 17 minutes at 15 frames/s
WARM = 300  # frames after which memory may grow no more
SEEN = 0.6  # of the rear plane must be visible where a frame counts
OFF_RANGE, OFF_PLACE = 0.2, 0.25  # relative, and in widths of the vehicle: an estimate that is of something else
DOUBTFUL = 25.0  # degrees of ViSP's projection error; 99 of 100 frames on target were below it where it was chosen


@dataclass(frozen=True, eq=False)
class Sight:
    """An estimate that its tracker stands by: position and its standard deviation (3,) in metres."""

    position: Array
    std: Array | None


class Follower(Protocol):
    def update(self, image: Image, truth: ChaseTruth) -> Sight | None: ...
    def spent(self) -> float:
        """CPU time of its own, in seconds, counted from any moment."""
        ...


class InThisThread:
    def spent(self) -> float:
        return time.thread_time()


def operators_start(scene: ChaseScene, first: ChaseTruth) -> tuple[Target, Array]:
    """The target, and its centre in the first picture, px, and scale (3,), as an operator would give them."""
    document, start = target_document(scene), start_document(scene, first)
    names = list(document["corners"])
    target = Target(
        document["name"],
        document["nominal_range"],
        np.array(list(document["corners"].values())),
        np.array([[names.index(a), names.index(b)] for a, b in document["segments"]]),
    )
    return target, np.array([*start["center"], start["scale"]])


class Paceline(InThisThread):
    """`FollowTracker`; of the truth it takes time and odometry."""

    def __init__(self, scene: ChaseScene, first: ChaseTruth, configuration: FollowConfiguration) -> None:
        self.tracker = FollowTracker(scene.camera, *operators_start(scene, first), configuration)

    def update(self, image: Image, truth: ChaseTruth) -> Sight | None:
        e = self.tracker.update(image, truth.time, truth.frame, Pose(truth.x, truth.y, truth.heading))
        return Sight(e.position, e.position_std) if e.status == "tracking" else None


class ViSP:
    """A model-based tracker of ViSP, with Paceline's model and start."""

    def __init__(self, program: Path, kind: str, scene: ChaseScene, first: ChaseTruth) -> None:
        target, (*center, scale) = operators_start(scene, first)
        start = target.nominal_range / scale * scene.camera.rays(np.array(center))
        self.tracker = EdgeTracker(program, kind, scene.camera, target, start)
        self.seconds = 0.0

    def update(self, image: Image, truth: ChaseTruth) -> Sight | None:
        step = self.tracker.track(image)
        self.seconds += step.seconds
        return Sight(step.position, None) if step.tracked and step.projection_error < DOUBTFUL else None

    def spent(self) -> float:
        return self.seconds


class OpenCV(InThisThread):
    """A tracker of boxes; range from the box's width."""

    def __init__(self, make: Callable[[], cv2.Tracker], scene: ChaseScene, first: ChaseTruth) -> None:
        self.tracker, self.camera, self.started = make(), scene.camera, False
        x, y = np.rint(first.corners.min(0)).astype(int).tolist()
        w, h = np.rint(np.ptp(first.corners, axis=0)).astype(int).tolist()
        self.box: Sequence[int] = (x, y, w, h)
        self.width = float(first.position[2] * self.box[2] / self.camera.K[0, 0])  # the true one, but for rounding

    def update(self, image: Image, truth: ChaseTruth) -> Sight | None:
        colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        found = True
        if self.started:
            found, self.box = self.tracker.update(colour)
        else:
            self.tracker.init(colour, self.box)
            self.started = True
        x, y, w, h = self.box
        if not found or w <= 0:
            return None
        z = self.camera.K[0, 0] * self.width / w
        ray = self.camera.rays(np.array([x + (w - 1) / 2, y + (h - 1) / 2]))
        return Sight(z * ray, None)


PUBLISHED = "Paceline, as published"
Maker = Callable[[ChaseScene, ChaseTruth], Follower]
Makers = dict[str, Maker]


def followers(peers: bool, visp: Path | None = None) -> Makers:
    """Every tracker that is installed, by name; ``visp`` is the compiled program."""
    made: Makers = {
        "Paceline": partial(Paceline, configuration=FollowConfiguration()),
        PUBLISHED: partial(Paceline, configuration=FollowConfiguration.as_published()),
    }
    if peers:
        for name in ("CSRT", "KCF", "MIL"):
            if (tracker := getattr(cv2, f"Tracker{name}", None)) is not None:
                made[f"OpenCV {name}"] = partial(OpenCV, tracker.create)
    if peers and visp is not None:
        made["ViSP, pose"] = partial(ViSP, visp, "pose")
        made["ViSP, position"] = partial(ViSP, visp, "position")
    return made


@dataclass
class Record:
    """What one tracker did on one clip, over the frames in which the vehicle can be seen."""

    follower: str
    scene: ChaseScene
    frames: int = 0
    lost: int = 0  # not claimed to be tracked
    wrong: int = 0  # claimed, and far off
    until: int = 0  # frames until the target was lost for good
    range_errors: list[float] = field(default_factory=list)  # relative
    on_target: list[float] = field(default_factory=list)  # those of them that are not wrong
    lateral_errors: list[float] = field(default_factory=list)  # m
    in_range: list[bool] = field(default_factory=list)  # within the stated ± 95 %
    in_lateral: list[bool] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)

    def add(self, sight: Sight | None, truth: ChaseTruth, width: float, milliseconds: float) -> None:
        self.milliseconds.append(milliseconds)
        if truth.visible < SEEN:
            return
        self.frames += 1
        if sight is None:
            self.lost += 1
            return
        x, _, z = sight.position - truth.position
        aside = np.linalg.norm(sight.position / sight.position[2] * truth.position[2] - truth.position)
        self.range_errors.append(float(z / truth.position[2]))
        if abs(z) > OFF_RANGE * truth.position[2] or aside > OFF_PLACE * width:
            self.wrong += 1
        else:
            self.until = self.frames
            self.on_target.append(self.range_errors[-1])
        self.lateral_errors.append(float(x))
        if sight.std is not None:
            self.in_range.append(bool(abs(z) <= COVERAGE_95 * sight.std[2]))
            self.in_lateral.append(bool(abs(x) <= COVERAGE_95 * sight.std[0]))


Frames = Iterable[tuple[Image, ChaseTruth]]


def run(scene: ChaseScene, makers: Makers) -> list[Record]:
    """All trackers over the frames of one clip, one after the other: a tracker has the processor's caches to itself."""
    frames = list(render_frames(scene))
    return [followed(scene, name, make, frames) for name, make in makers.items()]


def followed(scene: ChaseScene, name: str, make: Maker, frames: Frames) -> Record:
    """One tracker over the ``frames`` of a clip."""
    cv2.setNumThreads(1)
    record, follower = Record(name, scene), None
    for image, truth in frames:
        follower = follower or make(scene, truth)
        width = float(np.linalg.norm(truth.corners[1] - truth.corners[0])) * truth.position[2] / scene.focal
        before = follower.spent()
        sight = follower.update(image, truth)
        record.add(sight, truth, width, 1e3 * (follower.spent() - before))
    return record


def _run_seed(seed: int, args: argparse.Namespace, makers: Makers) -> list[Record]:
    return run(random_chase(seed, args.preset, **rendering(args, args.frames)), makers)


def rendering(args: argparse.Namespace, frames: int) -> dict[str, Any]:
    """What the command line fixes of a scene."""
    return {"frames": frames, "readout": args.readout, "vibration": args.vibration}


COLUMNS = (
    "frames",
    "lost",
    "wrong",
    "until lost for good",
    "range RMS, %",
    "on target",
    "worst, %",
    "lateral RMS, m",
    "covered: range",
    "lateral",
    "ms, median",
    "99 %",
)


def cells(records: Sequence[Record]) -> tuple[str, ...]:
    """The columns of a table for some records together."""

    def all_of(name: str) -> Array:
        return np.concatenate([getattr(r, name) for r in records])

    def share(name: str) -> str:
        return f"{np.mean(all_of(name)):.0%}" if len(all_of(name)) else "–"

    errors, lateral, ms = (all_of(n) for n in ("range_errors", "lateral_errors", "milliseconds"))
    right = all_of("on_target")
    numbers = ("–", "–", "–")
    if len(errors):
        numbers = f"{100 * rms(errors):.2f}", f"{100 * np.abs(errors).max():.1f}", f"{rms(lateral):.3f}"
    return (
        *(str(sum(getattr(r, n) for r in records)) for n in ("frames", "lost", "wrong")),
        f"{np.mean([r.until for r in records]):.0f}",
        numbers[0],
        f"{100 * rms(right):.2f}" if len(right) else "–",
        *numbers[1:],
        share("in_range"),
        share("in_lateral"),
        f"{np.median(ms):.2f}",
        f"{np.percentile(ms, 99):.2f}",
    )


def compare(args: argparse.Namespace) -> None:
    if not args.no_peers and not hasattr(cv2, "TrackerCSRT"):
        print("This OpenCV has no CSRT and KCF trackers (opencv-contrib has): left out.")
    with tempfile.TemporaryDirectory() as folder:
        visp = None if args.no_peers else compiled(Path(folder))
        if not args.no_peers and visp is None:
            print("ViSP (libvisp-dev, pkg-config and a C++ compiler) is not installed: its trackers are left out.")
        _compare(args, followers(not args.no_peers, visp))


def _compare(args: argparse.Namespace, makers: Makers) -> None:
    work = partial(_run_seed, args=args, makers=makers)
    print("\n" + head("clip", "vehicle", "tracker", *COLUMNS), flush=True)
    records: list[Record] = []
    for done in share_out(work, range(args.seed, args.seed + args.n), args.workers):
        records += done
        for r in done:
            print(row(r.scene.seed, f"{r.scene.kind}, {r.scene.paint:.0f}", r.follower, *cells([r])), flush=True)
    print("\n" + head("tracker", "clips without a frame lost or wrong", *COLUMNS))
    for name in dict.fromkeys(r.follower for r in records):
        mine = [r for r in records if r.follower == name]
        whole = sum(r.lost + r.wrong == 0 for r in mine)
        print(row(name, f"{whole} of {len(mine)}", *cells(mine)))


def long_run(args: argparse.Namespace) -> None:
    """One vehicle for as long as the paper's tape; memory before and after."""
    scene = random_chase(args.seed, args.preset, **rendering(args, LONG))
    held: dict[int, float] = {}

    def watched() -> Iterator[tuple[Image, ChaseTruth]]:
        for image, truth in render_frames(scene):
            yield image, truth
            held[truth.frame] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    record = followed(scene, "Paceline", followers(False)["Paceline"], watched())
    print(head("seed", "vehicle", *COLUMNS))
    print(row(scene.seed, f"{scene.kind}, {scene.paint:.0f}", *cells([record])))
    early, late = held[WARM], held[LONG - 1]
    print(f"\nPeak memory {early:.0f} MB after {WARM} frames and {late:.0f} MB after all, the renderer's included.")


def main() -> None:
    parser = argparse.ArgumentParser(description="Following rendered vehicles, beside other trackers.")
    parser.add_argument("--n", type=int, default=20, help="number of clips")
    parser.add_argument("--seed", type=int, default=500, help="seed of the first clip")
    parser.add_argument("--preset", choices=sorted(CHASE_PRESETS), default="nist", help="camera, speeds and distances")
    parser.add_argument("--frames", type=int, default=450, help="frames of each clip")
    parser.add_argument("--readout", type=float, default=0.0, help="s from the first row's exposure to the last one's")
    parser.add_argument("--vibration", type=float, default=0.0, help="rad RMS about each axis of the camera")
    parser.add_argument("--no-peers", action="store_true", help="leave OpenCV's and ViSP's trackers out")
    parser.add_argument("--long", action="store_true", help=f"one clip of {LONG} frames instead")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    long_run(args) if args.long else compare(args)
    print("\n" + machine())


if __name__ == "__main__":
    main()
