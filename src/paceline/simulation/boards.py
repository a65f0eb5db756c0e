"""Simulated stereo images of calibration boards with exact truth, for practice, tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from paceline.arrays import Array
from paceline.calibration.boards import Board, Corners
from paceline.calibration.parameters import Observations, Poses, RigState, rotation_matrix
from paceline.calibration.projection import lens_projection, project

PIXELS_PER_SQUARE = 48  # of the printed board
BOARD_SUBPIXELS_PER_SIDE = 2  # the picture is drawn on a finer grid and averaged
NODE_SPACING_PX = 8  # px between the directions that are computed exactly
PAPER_GREY, INK_GREY, WALL_GREY = 225.0, 25.0, 110.0  # grey levels


@dataclass(frozen=True, eq=False)
class CalibrationSetup:
    """A rig, its image size (width, height), and the poses in which the board is held."""

    rig: RigState
    size: tuple[int, int]
    board: Board
    poses: Poses


def random_setup(
    rng: np.random.Generator, board: Board, views: int, size: tuple[int, int] = (1280, 960), distortion: int = 2
) -> CalibrationSetup:
    """A rig of random focal length, baseline and angles, with the given number of distortion coefficients, and
    ``views`` poses that show the board large, tilted and all over the image."""
    width, height = size
    focal = rng.uniform(0.9, 2.4) * width
    lenses = np.zeros((2, 9))
    strength = np.array([rng.uniform(-0.25, 0.05), rng.uniform(-0.1, 0.2), *rng.normal(0, 5e-4, 2), 0.0])
    for lens in lenses:
        lens[:2] = focal * (1 + rng.normal(0, 0.01)) * (1 + rng.normal(0, 1e-3, 2))
        lens[2:4] = (np.array(size) - 1) / 2 + rng.normal(0, 0.01, 2) * width
        lens[4:] = np.where(np.arange(5) < distortion, strength * rng.uniform(0.9, 1.1), 0.0)
    R = rotation_matrix(rng.normal(0, [0.01, 0.02, 0.01]))
    t = np.array([-rng.uniform(0.3, 0.8), *rng.normal(0, 0.02, 2)])
    rig = RigState(lenses, R, t)
    return CalibrationSetup(rig, size, board, _draw_poses(rng, rig, size, board, views))


def _draw_poses(rng: np.random.Generator, rig: RigState, size: tuple[int, int], board: Board, views: int) -> Poses:
    """Poses in which both views hold most of the board, a chessboard whole; it covers a third to two thirds of them."""
    points = board.points
    min_corners = max(0.6 * len(points), board.min_corners)
    middle, extent = points.mean(0), np.ptp(points, axis=0)
    rotations: list[Array] = []
    places: list[Array] = []
    while len(places) < views:
        R = rotation_matrix(rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.25])
        depth = rig.lenses[0, 1] * extent[1] / (rng.uniform(0.3, 0.65) * size[1])
        direction = (rng.uniform(0.1, 0.9, 2) * size - rig.lenses[0, 2:4]) / rig.lenses[0, :2]
        t = depth * np.array([*direction, 1.0]) - R @ middle
        observations = project_board(Poses(R[None], t[None]), rig, board, size)
        if all((observations.side == side).sum() >= min_corners for side in (0, 1)):
            rotations.append(R)
            places.append(t)
    return Poses(np.array(rotations), np.array(places))


def project_board(poses: Poses, rig: RigState, board: Board, size: tuple[int, int]) -> Observations:
    """Exact corners that lie inside both images' borders."""
    V, points = len(poses.t), board.points
    n = len(points)
    view, side = np.repeat(np.arange(V), 2 * n), np.tile(np.repeat([0, 1], n), V)
    all_points = Observations(view, side, np.tile(points, (2 * V, 1)), np.zeros((2 * V * n, 2)))
    pixels, _, _ = project(rig, poses, all_points)
    inside = ((pixels > 8) & (pixels < np.array(size) - 9)).all(1)
    return Observations(view[inside], side[inside], all_points.points[inside], pixels[inside])


def add_noise(rng: np.random.Generator, observations: Observations, sigma: float) -> Observations:
    """``observations`` with errors of that standard deviation in every coordinate, px."""
    return Observations(
        observations.view,
        observations.side,
        observations.points,
        observations.pixels + rng.normal(0, sigma, observations.pixels.shape),
    )


def corners_by_view(observations: Observations, board: Board) -> list[tuple[Corners, Corners]]:
    """The corners of every view as a finder returns them, left and right."""
    pairs = []
    for v in range(int(observations.view.max()) + 1):
        views = []
        for side in (0, 1):
            in_view = observations.select((observations.view == v) & (observations.side == side))
            ids = np.abs(in_view.points[:, None] - board.points).sum(-1).argmin(1)
            views.append(Corners(ids, in_view.pixels))
        pairs.append((views[0], views[1]))
    return pairs


def board_pattern(board: Board) -> NDArray[np.uint8]:
    """The board's pattern, ``PIXELS_PER_SQUARE`` a square, with a margin of one square."""
    p = PIXELS_PER_SQUARE
    if board.marker is not None:
        pattern = board.charuco().generateImage((board.columns * p, board.rows * p), marginSize=0)
    else:
        rows, columns = np.mgrid[: board.rows + 1, : board.columns + 1]
        pattern = np.kron(((rows + columns) % 2 * 255).astype(np.uint8), np.ones((p, p), np.uint8))
    return np.asarray(cv2.copyMakeBorder(pattern, p, p, p, p, cv2.BORDER_CONSTANT, value=(255.0,)), np.uint8)


def render(
    setup: CalibrationSetup, view: int, rng: np.random.Generator, blur: float = 0.7, noise: float = 2.0
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both cameras' pictures (H, W) of the board in a view; ``blur`` (px) and ``noise`` (grey levels) are standard
    deviations."""
    pattern = board_pattern(setup.board).astype(np.float32)
    R, t = setup.poses.R[view], setup.poses.t[view]
    poses = [(R, t), (setup.rig.R @ R, setup.rig.R @ t + setup.rig.t)]
    left, right = (
        _render_view(setup, pattern, lens, pose, rng, blur, noise)
        for lens, pose in zip(setup.rig.lenses, poses, strict=True)
    )
    return left, right


def _render_view(
    setup: CalibrationSetup,
    pattern: NDArray[np.float32],
    lens: Array,
    pose: tuple[Array, Array],
    rng: np.random.Generator,
    blur: float,
    noise: float,
) -> NDArray[np.uint8]:
    R, t = pose
    low, high = _board_window(setup, lens, pose)
    rays = _undistorted_rays(lens, low, high)
    H = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], t]))  # rays to metres on the board
    x, y, w = (H[i, 0] * rays[..., 0] + H[i, 1] * rays[..., 1] + H[i, 2] for i in range(3))
    squares = np.stack([x / w, y / w], -1) / setup.board.square + 2  # a square of margin, one to the first inner corner
    texture_position = squares * PIXELS_PER_SQUARE - 0.5
    shrink = float(np.median(np.linalg.norm(np.diff(texture_position[::8, ::8], axis=1), axis=-1))) / 8
    soft = cv2.GaussianBlur(pattern, (0, 0), max(0.4 * shrink, 0.3))
    across, down = (np.ascontiguousarray(texture_position[..., i], np.float32) for i in (0, 1))
    drawn = cv2.remap(soft, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1.0)
    board_image = np.where(drawn < 0, WALL_GREY, INK_GREY + (PAPER_GREY - INK_GREY) * drawn / 255)
    picture = np.full(setup.size[::-1], WALL_GREY)
    picture[low[1] : high[1], low[0] : high[0]] = cv2.resize(
        board_image, (high - low).tolist(), interpolation=cv2.INTER_AREA
    )
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), max(blur, 0.05)), float)
    return np.clip(np.rint(picture + rng.normal(0, noise, picture.shape)), 0, 255).astype(np.uint8)


def _board_window(
    setup: CalibrationSetup, lens: Array, pose: tuple[Array, Array]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last pixel (x, y) of the part of the picture that the printed board may reach."""
    points = setup.board.points
    span = points.max(0)
    edge = np.array([[x, y, 0.0] for x in (-0.4, 0.5, 1.4) for y in (-0.4, 0.5, 1.4)]) * span
    R, t = pose
    pixels = lens_projection(np.tile(lens, (len(edge), 1)), edge @ R.T + t)[0]
    limit = np.array(setup.size)
    low = np.clip(np.floor(pixels.min(0)), 0, limit - 16).astype(np.int64)
    return low, np.clip(np.ceil(pixels.max(0)) + 1, low + 16, limit).astype(np.int64)


def _undistorted_rays(lens: Array, low: NDArray[np.int64], high: NDArray[np.int64]) -> Array:
    """Directions (x, y) with z = 1 through the pixels of the finer grid from ``low`` to ``high``: exact every few
    pixels, splines between."""
    K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    x, y = (
        np.arange(a - 2 * NODE_SPACING_PX, b + 3 * NODE_SPACING_PX, NODE_SPACING_PX)
        for a, b in zip(low, high, strict=True)
    )
    nodes = np.stack(np.meshgrid(x, y), -1).astype(float)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    exact = cv2.undistortPoints(nodes.reshape(-1, 1, 2), K, lens[4:], criteria=criteria).reshape(nodes.shape)
    across, down = (
        a + (np.arange((b - a) * BOARD_SUBPIXELS_PER_SIDE) + 0.5) / BOARD_SUBPIXELS_PER_SIDE - 0.5
        for a, b in zip(low, high, strict=True)
    )
    return np.stack([RectBivariateSpline(y, x, exact[..., i])(down, across) for i in (0, 1)], -1)
