"""Calibration boards: parsing of a board's description, and detection of its corners in an image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Indices, to_8_bit
from paceline.errors import UnusableInput

BoardDetector = Callable[[Image], "Corners"]

EXPECTED_BOARD = (
    "expected charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY, squares counted and sizes in metres "
    "(charuco:11x8:0.06:0.045:DICT_5X5_100), or chessboard:COLUMNSxROWS:SQUARE, inner corners counted "
    "(chessboard:9x6:0.05)"
)
MAX_SQUARES_PER_SIDE = 100
MAX_SQUARE_M = 2.0
CORNER_WINDOW_SHARE, CORNER_WINDOW_LIMITS_PX = (
    0.75,
    (2, 9),
)  # half width of the corner window: share of the distance to a marker, px
SUBPIXEL_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
MAX_REFINEMENT_SHIFT_PX = 1.5  # greatest distance between OpenCV's corner and the refined one
MIN_CORNERS = 8  # least corners in a view of a ChArUco board; fewer hardly determine a pose and a lens


@dataclass(frozen=True)
class Board:
    """A flat board. ``columns`` × ``rows`` are squares of a ChArUco board, inner corners of a chessboard.

    ``square`` and ``marker`` are in metres. ``legacy``: a ChArUco pattern as OpenCV printed it before version 4.6.
    """

    columns: int
    rows: int
    square: float
    marker: float | None = None  # None: a chessboard
    dictionary: str = ""
    legacy: bool = False

    @property
    def points(self) -> Array:
        """All inner corners (N, 3) in metres on the board's plane z = 0, row by row."""
        columns, rows = (self.columns, self.rows) if self.marker is None else (self.columns - 1, self.rows - 1)
        y, x = np.mgrid[:rows, :columns]
        return self.square * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)

    @property
    def min_corners(self) -> int:
        """Corners of a usable view: a chessboard is detected whole or not at all."""
        return len(self.points) if self.marker is None else min(MIN_CORNERS, len(self.points))

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's description of a ChArUco board."""
        assert self.marker is not None
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)
        board.setLegacyPattern(self.legacy)
        return board


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners found in one image: places ``ids`` (n,) in :attr:`Board.points`, and ``pixels`` (n, 2) as recorded."""

    ids: Indices
    pixels: Array

    def __len__(self) -> int:
        return len(self.ids)


def parse_board(text: str) -> Board:
    """The board that ``text`` names, as ``--board`` takes it; raises UnusableInput where it is invalid."""
    kind, *arguments = text.split(":")
    legacy = kind == "charuco" and arguments[4:] == ["legacy"]
    if (kind, len(arguments) - legacy) not in (("charuco", 4), ("chessboard", 2)):
        raise UnusableInput(f"--board {text}: {EXPECTED_BOARD}")
    columns, rows = _counts(text, arguments[0])
    square = _size(text, "square", arguments[1], MAX_SQUARE_M)
    if kind == "chessboard":
        if min(columns, rows) < 3:
            raise UnusableInput(f"--board {text}: {columns}x{rows} corners; expected at least 3x3")
        return Board(columns, rows, square)
    if min(columns, rows) < 3:
        raise UnusableInput(f"--board {text}: {columns}x{rows} squares; expected at least 3x3")
    marker = _size(text, "marker", arguments[2], square)
    name = arguments[3] if arguments[3].startswith("DICT_") else f"DICT_{arguments[3]}"
    if not hasattr(cv2.aruco, name):
        known = "DICT_4X4_50, DICT_5X5_100, DICT_6X6_250, DICT_APRILTAG_36h11 and others of OpenCV's"
        raise UnusableInput(f"--board {text}: unknown dictionary {arguments[3]!r}; expected one of {known}")
    held = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)
    if columns * rows // 2 > held:
        raise UnusableInput(
            f"--board {text}: {columns}x{rows} squares hold {columns * rows // 2} markers; {name} has {held}"
        )
    return Board(columns, rows, square, marker, name, legacy)


def _counts(text: str, part: str) -> tuple[int, int]:
    columns, cross, rows = part.partition("x")
    if not (cross and columns.isdecimal() and rows.isdecimal()):
        raise UnusableInput(f"--board {text}: {part!r} is no COLUMNSxROWS; {EXPECTED_BOARD}")
    if max(int(columns), int(rows)) > MAX_SQUARES_PER_SIDE:
        raise UnusableInput(f"--board {text}: {part} is more than {MAX_SQUARES_PER_SIDE} a side")
    return int(columns), int(rows)


def _size(text: str, quantity: str, part: str, largest: float) -> float:
    try:
        size = float(part)
    except ValueError:
        raise UnusableInput(f"--board {text}: {quantity} {part!r} is no number; {EXPECTED_BOARD}") from None
    if not 1e-3 <= size <= MAX_SQUARE_M:
        raise UnusableInput(
            f"--board {text}: the {quantity} measures {part}; expected metres, 0.001 to {MAX_SQUARE_M:g}"
        )
    if quantity == "marker" and size >= largest:
        raise UnusableInput(f"--board {text}: the marker ({part} m) is not smaller than the square ({largest:g} m)")
    return size


def board_detector(board: Board) -> BoardDetector:
    """A function that detects the corners of ``board`` in an image (H, W), 0–255; none where it is not visible."""
    return _chessboard_detector(board) if board.marker is None else _charuco_detector(board)


def _charuco_detector(board: Board) -> BoardDetector:
    pattern = board.charuco()
    detector = cv2.aruco.CharucoDetector(pattern)

    def detect(image: Image) -> Corners:
        pixels, ids, *_ = detector.detectBoard(to_8_bit(image))
        if ids is None or len(ids) < board.min_corners or pattern.checkCharucoCornersCollinear(ids):
            return NO_CORNERS
        order = np.argsort(np.ravel(ids))
        corners = Corners(np.ravel(ids)[order].astype(np.int64), np.reshape(pixels, (-1, 2))[order].astype(float))
        return _refine_corners(board, corners, to_8_bit(image))

    return detect


def _refine_corners(board: Board, corners: Corners, image: NDArray[np.uint8]) -> Corners:
    """ChArUco ``corners`` refined in windows that stay clear of the markers.

    OpenCV chooses its windows by the image's size; they may reach into a marker, whose edges bias the corner by tenths
    of a pixel.
    """
    assert board.marker is not None
    on_board = board.points[corners.ids]
    H = cv2.findHomography(on_board[:, :2], corners.pixels)[0]
    if H is None:
        return NO_CORNERS
    gap = (board.square - board.marker) / 2
    steps = gap * np.array([[1, 0], [-1, 0], [0, 1], [0, -1.0]])
    around = cv2.perspectiveTransform((on_board[:, None, :2] + steps).reshape(-1, 1, 2), H).reshape(-1, 4, 2)
    clear = np.linalg.norm(around - corners.pixels[:, None], axis=2).min(1)
    windows = np.clip(CORNER_WINDOW_SHARE * clear, *CORNER_WINDOW_LIMITS_PX).astype(int)
    pixels = corners.pixels.copy()
    for size in np.unique(windows):
        in_group = windows == size
        start = pixels[in_group].astype(np.float32).reshape(-1, 1, 2)
        pixels[in_group] = cv2.cornerSubPix(image, start, (size, size), (-1, -1), SUBPIXEL_CRITERIA).reshape(-1, 2)
    accepted = (
        np.linalg.norm(pixels - corners.pixels, axis=1) < MAX_REFINEMENT_SHIFT_PX
    )  # farther away another feature was found
    return Corners(corners.ids[accepted], pixels[accepted]) if accepted.sum() >= board.min_corners else NO_CORNERS


def _chessboard_detector(board: Board) -> BoardDetector:
    size = board.columns, board.rows

    def detect(image: Image) -> Corners:
        is_found, pixels = cv2.findChessboardCornersSB(to_8_bit(image), size, flags=cv2.CALIB_CB_ACCURACY)
        if not is_found:
            return NO_CORNERS
        return Corners(np.arange(len(board.points)), np.reshape(pixels, (-1, 2)).astype(float))

    return detect


def matching_order(left: Corners, right: Corners) -> Corners:
    """``right`` with a chessboard's corners counted from the end that they are counted from in ``left``.

    A chessboard looks the same turned by half a turn; the cameras of a rig are not turned against each other.
    """
    along = [c.pixels[-1] - c.pixels[0] for c in (left, right)]
    return right if along[0] @ along[1] >= 0 else Corners(right.ids, right.pixels[::-1].copy())


NO_CORNERS = Corners(np.empty(0, np.int64), np.empty((0, 2)))
