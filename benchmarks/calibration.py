"""Boards filmed by rigs that are known exactly: do the stated 95 % intervals hold, and are wrong views found?

python benchmarks/calibration.py [--n 60] [--rendered 24] [--seed 100] [--workers 2]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import cv2
import numpy as np
from common import Array, head, machine, rms, row, share_out

from paceline.calibration.board_calibration import Calibration, calibrate
from paceline.calibration.board_views import BoardView, BoardViews
from paceline.calibration.boards import Corners, board_detector, matching_order, parse_board
from paceline.calibration.parameters import RIG_PARAMETER_NAMES, RigState, parameter_step
from paceline.errors import UnusableInput
from paceline.geometry import triangulate
from paceline.simulation.boards import CalibrationSetup, add_noise, corners_by_view, project_board, random_setup, render
from paceline.units import COVERAGE_95

BOARDS = ("charuco:11x8:0.06:0.045:DICT_5X5_100", "charuco:7x5:0.1:0.075:DICT_4X4_50", "chessboard:9x6:0.06")
SIZES = ((1280, 960), (1024, 768), (1920, 1080))
RENDERED_SIZE = (1024, 768)
JUDGED = 50.0  # m
SPEED = "speed at 50 m"  # along the line of sight, in the middle of the picture
Pair = tuple[Corners, Corners]


@dataclass(frozen=True)
class Outcome:
    """One run: errors and half intervals (25,) of the parameters and of the speed; which views were spoilt and which
    were left out."""

    seed: int
    what: str
    errors: Array
    halves: Array
    spoilt: set[int]
    rejected: set[int]
    refused: str
    seconds: float


def run(task: tuple[int, bool]) -> Outcome:
    """The calibration of one random rig, from projected corners or from rendered pictures."""
    seed, rendered = task
    rng = np.random.default_rng(seed)
    board = parse_board(BOARDS[0 if rendered and seed % 4 else seed % 3])
    views = int(rng.integers(10, 18) if rendered else rng.integers(10, 31))
    distortion = int(rng.choice([0, 1, 2, 4]))
    size = RENDERED_SIZE if rendered else SIZES[seed % 3]
    setup = random_setup(rng, board, views, size, distortion)
    sigma = float(rng.uniform(0.05, 0.4))
    if rendered:
        pairs, spoilt = _filmed(setup, rng)
        what = f"rendered, {views} views, {board.columns}x{board.rows}, {distortion} coefficients"
    else:
        exact = project_board(setup.poses, setup.rig, board, size)
        pairs, spoilt = _spoilt(corners_by_view(add_noise(rng, exact, sigma), board), rng, sigma)
        what = f"{sigma:.2f} px, {views} views, {board.columns}x{board.rows}, {distortion} coefficients"
    began = time.perf_counter()
    found = BoardViews(board, [BoardView(str(i), *pair) for i, pair in enumerate(pairs)], [], (size, size), [])
    try:
        c = calibrate(found)
    except UnusableInput as error:
        undefined = np.full(len(RIG_PARAMETER_NAMES) + 1, np.nan)
        return Outcome(seed, what, undefined, undefined, spoilt, set(), str(error), time.perf_counter() - began)
    seconds = time.perf_counter() - began
    effect = next(e.along for e in c.effects if e.distance == JUDGED)
    errors = np.append(parameter_step(c.fit.rig, setup.rig), speed_error(c, setup.rig))
    return Outcome(
        seed, what, errors, c.coverage_factor * np.append(c.std, effect), spoilt, set(c.rejected), "", seconds
    )


def speed_error(c: Calibration, true: RigState) -> float:
    """By how much a speed at 50 m along the line of sight really comes out wrong, through the whole lens model."""
    ends = np.array([[0.0, 0.0, JUDGED - 5], [0.0, 0.0, JUDGED + 5]])
    truth = true.stereo(c.views.sizes)
    estimated = []
    for side, (camera, found) in enumerate(zip(truth.cameras, c.rig.cameras, strict=True)):
        points = ends if side == 0 else truth.to_right(ends)
        D = camera.distortion if camera.has_distortion else np.zeros(5)
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, D)[0]
        estimated.append(found.undistort_points(np.asarray(pixels, float)[:, 0]))
    measured = triangulate(c.rig, estimated[0], estimated[1])
    return float(np.linalg.norm(measured[1] - measured[0])) / 10.0 - 1


def _spoilt(pairs: list[Pair], rng: np.random.Generator, sigma: float) -> tuple[list[Pair], set[int]]:
    """Some of: a pair that does not belong together, a picture with scattered corners, a board taken for another."""
    kinds = [kind for kind in range(3) if rng.uniform() < 0.5]
    at = rng.choice(len(pairs), len(kinds), replace=False).tolist()
    for v, kind in zip(at, kinds, strict=True):
        left, right = pairs[v]
        if kind == 0:  # moved by some pixels between the exposures
            direction = rng.normal(size=2)
            way = rng.uniform(15, 60) * sigma * direction / np.linalg.norm(direction)
            right = Corners(right.ids, right.pixels + way)
        elif kind == 1:  # blurred
            left = Corners(left.ids, left.pixels + rng.normal(0, 8 * sigma, left.pixels.shape))
        else:  # the corners counted wrongly
            right = Corners(right.ids, rng.permutation(right.pixels))
        pairs[v] = (left, right)
    return pairs, set(at)


def _filmed(setup: CalibrationSetup, rng: np.random.Generator) -> tuple[list[Pair], set[int]]:
    """What the finder sees in rendered pictures; in one pair the board moves between the exposures."""
    find, pairs = board_detector(setup.board), []
    moved = int(rng.integers(len(setup.poses.t)))
    for v in range(len(setup.poses.t)):
        found = []
        for picture in render(setup, v, rng, float(rng.uniform(0.5, 1.2)), float(rng.uniform(1, 4))):
            found.append(find(picture.astype(np.float32)))
        if setup.board.marker is None and len(found[0]) and len(found[1]):
            found[1] = matching_order(found[0], found[1])
        if v == moved and len(found[1]):
            found[1] = Corners(found[1].ids, found[1].pixels + [3.0, 1.5])
        pairs.append((found[0], found[1]))
    visible = [i for i, (a, b) in enumerate(pairs) if len(a) or len(b)]
    both = len(pairs[moved][0]) and len(pairs[moved][1])
    return [pairs[i] for i in visible], {visible.index(moved)} if both else set()


def main() -> None:
    parser = argparse.ArgumentParser(description="Calibrations of rigs that are known.")
    parser.add_argument("--n", type=int, default=60, help="runs from projected corners")
    parser.add_argument("--rendered", type=int, default=24, help="runs from rendered pictures")
    parser.add_argument("--seed", type=int, default=100, help="seed of the first run")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    for name, count, rendered in (("projected corners", args.n, False), ("rendered pictures", args.rendered, True)):
        if count:
            tasks = [(args.seed + i, rendered) for i in range(count)]
            _report(name, list(share_out(run, tasks, args.workers)))
    print(machine())


def _report(name: str, outcomes: list[Outcome]) -> None:
    done = [o for o in outcomes if not o.refused]
    print(f"**{name}**: {len(done)} of {len(outcomes)} runs calibrated\n")
    print(head("parameter", "n", "within its 95 % interval", "error in standard uncertainties, rms"))
    errors, halves = np.array([o.errors for o in done]), np.array([o.halves for o in done])
    for k, parameter in enumerate([*RIG_PARAMETER_NAMES, SPEED]):
        stated = halves[:, k] > 0
        if stated.sum() >= len(done) // 4:  # a coefficient that hardly any lens needed says little
            share = np.abs(errors[stated, k]) / halves[stated, k]
            print(row(parameter, stated.sum(), f"{100 * (share <= 1).mean():.0f} %", f"{COVERAGE_95 * rms(share):.2f}"))
    spoilt, found = (sum(map(len, sets)) for sets in ([o.spoilt for o in done], [o.spoilt & o.rejected for o in done]))
    extra = sum(len(o.rejected - o.spoilt) for o in done)
    print(f"\nWrong views: {found} of {spoilt} found; {extra} good ones left out with them.")
    half, error = 100 * float(np.median(halves[:, -1])), 100 * rms(errors[:, -1])
    print(f"Speed at 50 m: median interval ± {half:.2f} %, error {error:.2f} % rms.")
    print(f"Median time {np.median([o.seconds for o in done]):.1f} s.")
    for o in outcomes:
        if o.refused or o.spoilt - o.rejected:
            print(f"* seed {o.seed}: {o.what}: {o.refused or f'views {sorted(o.spoilt - o.rejected)} not found'}")
    print(flush=True)


if __name__ == "__main__":
    main()
