"""Pairs of board images: their pairing, and the corners detected in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from paceline.arrays import Image
from paceline.calibration.boards import Board, BoardDetector, Corners, board_detector, matching_order
from paceline.calibration.parameters import Observations
from paceline.errors import UnusableInput
from paceline.progress import Progress
from paceline.recordings.image_sources import ImageFiles, ImageSource, open_source
from paceline.recordings.stereo import pair_by_time, pair_images
from paceline.verdicts import message

MAX_VIEWS = 80  # greatest number of views: longer recordings are subsampled evenly, as more views add little


@dataclass(frozen=True, eq=False)
class BoardView:
    """One pair of images: its name in messages, and the corners in each."""

    name: str
    left: Corners
    right: Corners

    @property
    def sides(self) -> tuple[Corners, Corners]:
        return self.left, self.right


@dataclass(frozen=True, eq=False)
class BoardViews:
    """Pairs in which at least one camera sees the board; ``empty`` names the others. ``sizes``: (width, height)."""

    board: Board
    views: list[BoardView]
    empty: list[str]
    sizes: tuple[tuple[int, int], tuple[int, int]]
    notices: list[str]


def collect_views(left: Path, right: Path, board: Board, progress: Progress | None = None) -> BoardViews:
    """The corners of ``board`` in two folders of images, patterns or videos.

    Raises UnusableInput where the two do not belong together, a file is bad or no picture shows the board.
    """
    if left.resolve() == right.resolve():
        raise UnusableInput(f"{left}: is given for both cameras; expected the left one's pictures and the right one's")
    sources = open_source(left), open_source(right)
    pairs, notices = _pairs(*sources)
    if len(pairs) > MAX_VIEWS:
        notices.append(message("pairs_thinned", used=MAX_VIEWS, pairs=len(pairs)))
        pairs = [pairs[i] for i in np.linspace(0, len(pairs) - 1, MAX_VIEWS).round().astype(int)]
    find = board_detector(board)
    views, empty, sizes = [], [], [(0, 0), (0, 0)]
    reads = [source.read([pair[side] for pair in pairs]) for side, source in enumerate(sources)]
    for k, (pair, *images) in enumerate(zip(pairs, *reads, strict=True)):
        name = _name(sources[0], pair[0])
        corners = [_find(find, image) for image in images]
        for side, image in enumerate(images):
            sizes[side] = _size(sources[side], pair[side], image, sizes[side])
        if len(corners[0]) and len(corners[1]) and board.marker is None:
            corners[1] = matching_order(corners[0], corners[1])
        if len(corners[0]) or len(corners[1]):
            views.append(BoardView(name, corners[0], corners[1]))
        else:
            empty.append(name)
        if progress:
            progress(k + 1, len(pairs))
    if not views:
        raise UnusableInput(f"{left} and {right}: no picture shows the board; is --board what was filmed?")
    for source in sources:
        notices += source.notices
    return BoardViews(board, views, empty, (sizes[0], sizes[1]), notices)


def _pairs(left: ImageSource, right: ImageSource) -> tuple[list[tuple[int, int]], list[str]]:
    if isinstance(left, ImageFiles) and isinstance(right, ImageFiles):
        pairing = pair_images(left, right, 1.0)
        notices: list[str] = [n for n in pairing.notices if n.code in ("frame_numbers_offset", "frames_unmatched")]
    elif left.times is None or right.times is None:
        raise UnusableInput(f"{left.name} and {right.name}: one is a video and the other images; expected alike")
    else:
        pairing = pair_by_time(left.times, right.times)
        notices = list(pairing.notices)
    return list(zip(pairing.left.tolist(), pairing.right.tolist(), strict=True)), notices


def _find(find: BoardDetector, image: Image | None) -> Corners:
    return Corners(np.empty(0, np.int64), np.empty((0, 2))) if image is None else find(image)


def _name(source: ImageSource, frame: int) -> str:
    return Path(source.label(frame)).name if isinstance(source, ImageFiles) else f"frame {frame}"


def _size(source: ImageSource, frame: int, image: Image | None, before: tuple[int, int]) -> tuple[int, int]:
    if image is None:
        return before
    size = image.shape[1], image.shape[0]
    if before not in ((0, 0), size):
        raise UnusableInput(
            f"{source.label(frame)}: has {size[0]} × {size[1]} pixels, the pictures before it {before[0]} × {before[1]}"
        )
    return size


def observations(board: Board, views: Sequence[BoardView]) -> Observations:
    """All corners of ``views``; each corner holds the index of its view."""
    view, side, points, pixels = [], [], [], []
    for v, pair in enumerate(views):
        for s, corners in enumerate(pair.sides):
            view.append(np.full(len(corners), v))
            side.append(np.full(len(corners), s))
            points.append(board.points[corners.ids])
            pixels.append(corners.pixels)
    return Observations(np.concatenate(view), np.concatenate(side), np.concatenate(points), np.concatenate(pixels))
